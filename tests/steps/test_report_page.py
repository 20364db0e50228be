"""The page of a report as a reader uses it, in headless Chromium: point, zoom, switch layers, without an error."""

from __future__ import annotations

import json
import shutil
import time
from typing import TYPE_CHECKING

import pytest

from geofleet.workflows.demo import run_demo

if TYPE_CHECKING:
    from pathlib import Path

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,900",
)
PATIENCE_S = 60
MAP = "Bokeh.documents[0].get_model_by_name('map')"
# Where a point of the map is in the window, with the map scrolled into sight.
PLACE = """
const plot = Bokeh.documents[0].get_model_by_name('map')
const view = Bokeh.index.get_one(plot)
const box = view.el.getBoundingClientRect()
const [name, row] = arguments
const data = plot.renderers.find((r) => r.name == name).data_source.data
const [x, y, frame] = [plot.x_range, plot.y_range, view.frame.bbox]
return [
  box.left + frame.left + (data.x[row] - x.start) / (x.end - x.start) * frame.width,
  box.top + frame.top + (y.end - data.y[row]) / (y.end - y.start) * frame.height,
]
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    run_demo(out, n_vehicles=10)
    return out / "report" / "report.html"


@pytest.fixture(scope="module")
def browser(tmp_path_factory, page):
    if not CHROMIUM or not DRIVER:
        pytest.skip("Chromium (chromium and chromium-driver) is not on this machine")
    from selenium import webdriver  # noqa: PLC0415
    from selenium.webdriver.chrome.options import Options  # noqa: PLC0415
    from selenium.webdriver.chrome.service import Service  # noqa: PLC0415

    options = Options()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(DRIVER))
    driver.get(page.as_uri())
    wait(lambda: driver.execute_script("return document.documentElement.dataset.ready"))
    driver.execute_script("document.getElementById('map').scrollIntoView({behavior: 'instant'})")
    wait(lambda: driver.execute_script(f"return {MAP}.inner_width") > 0)
    yield driver
    driver.quit()


def wait(condition):
    """Wait until something is so: a busy machine takes its time."""
    end = time.monotonic() + PATIENCE_S
    while not (found := condition()):
        assert time.monotonic() < end, "the page did not get there"
        time.sleep(0.1)
    return found


def move_to(driver, place):
    from selenium.webdriver.common.action_chains import ActionChains  # noqa: PLC0415

    chain = ActionChains(driver, duration=50)
    chain.w3c_actions.pointer_action.move_to_location(*(round(c) for c in place))
    chain.perform()


def ranges(driver):
    return driver.execute_script(
        f"const p = {MAP}, x = p.x_range, y = p.y_range;"
        "return [x.start, x.end, y.start, y.end, p.inner_width, p.inner_height]"
    )


def metres_a_pixel(driver):
    x0, x1, y0, y1, width, height = ranges(driver)
    return (x1 - x0) / width, (y1 - y0) / height


def texts(driver):
    """Return everything that is written, also inside the shadow roots of Bokeh's elements."""
    return driver.execute_script("""
        const found = []
        const walk = (node) => {
          if (['SCRIPT', 'STYLE'].includes(node.nodeName)) return
          if (node.nodeType == 3 && node.parentElement?.checkVisibility?.() !== false) found.push(node.textContent)
          if (node.shadowRoot) walk(node.shadowRoot)
          node.childNodes?.forEach(walk)
        }
        walk(document.body)
        return found.join(' ')
    """)


def pixels(driver, name):
    """Return how many pixels of a figure are neither white nor clear, and a sum that tells two drawings apart."""
    return driver.execute_script(
        """
        const view = Bokeh.index.get_one(Bokeh.documents[0].get_model_by_name(arguments[0]))
        const canvas = view.canvas_view.primary.canvas
        const data = canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data
        let [n, sum] = [0, 0]
        for (let i = 0; i < data.length; i += 4) {
          const light = data[i] + data[i + 1] + data[i + 2]
          if (data[i + 3] && light < 740) n++
          sum += light * (i % 65521)
        }
        return [n, sum]
        """,
        name,
    )


def test_every_figure_is_drawn(browser):
    for name in ("map", "errors", "offsets", "confusion"):
        assert wait(lambda name=name: pixels(browser, name)[0] > 1000), name


def test_both_axes_have_one_scale_also_in_a_narrow_window(browser):
    east, north = metres_a_pixel(browser)
    assert east == pytest.approx(north, rel=0.01)
    browser.set_window_size(700, 900)
    wait(lambda: ranges(browser)[4] < 700)
    wait(lambda: abs(metres_a_pixel(browser)[0] / metres_a_pixel(browser)[1] - 1) < 0.01)
    assert browser.execute_script("return document.documentElement.scrollWidth") <= 700  # nothing sticks out
    browser.execute_script(f"Bokeh.index.get_one({MAP}).reset()")
    wait(lambda: abs(metres_a_pixel(browser)[0] / metres_a_pixel(browser)[1] - 1) < 0.01)
    browser.set_window_size(1280, 900)
    wait(lambda: ranges(browser)[4] > 900)
    browser.execute_script("document.getElementById('map').scrollIntoView({behavior: 'instant'})")


@pytest.mark.parametrize("outcome", ["TP", "FN"])
def test_pointing_at_a_sign_tells_what_it_is(browser, outcome):
    source = f"{MAP}.renderers.find((r) => r.name == '{outcome}').data_source.data"
    browser.execute_script(f"{MAP}.reset.emit()")
    sign, sign_class = browser.execute_script(f"return [{source}.sign[0], {source}.sign_class[0]]")
    evidence = browser.execute_script(f"return {source}.evidence[0]")
    move_to(browser, browser.execute_script(PLACE, outcome, 0))
    shown = wait(lambda: (t := texts(browser)) and sign in t and t)
    assert sign_class in shown
    assert evidence in shown
    assert ("passes" if outcome == "TP" else "not in the map") in shown


def test_the_wheel_zooms_and_reset_shows_all(browser):
    from selenium.webdriver.common.action_chains import ActionChains  # noqa: PLC0415
    from selenium.webdriver.common.actions.wheel_input import ScrollOrigin  # noqa: PLC0415

    before = metres_a_pixel(browser)
    x, y = browser.execute_script(PLACE, "TP", 0)
    ActionChains(browser).scroll_from_origin(ScrollOrigin.from_viewport(round(x), round(y)), 0, -240).perform()
    wait(lambda: metres_a_pixel(browser)[0] < 0.9 * before[0])
    east, north = metres_a_pixel(browser)
    assert east == pytest.approx(north, rel=0.01)
    view = f"Bokeh.index.get_one({MAP})"
    browser.execute_script(f"{view}.reset()")
    wait(lambda: abs(metres_a_pixel(browser)[0] / before[0] - 1) < 0.02)


def test_a_click_in_the_legend_switches_a_layer(browser):
    legend = f"{MAP}.center.find((part) => part.type == 'Legend')"
    assert browser.execute_script(f"return {legend}.items.length") == 10
    for name, label in (("TP", "found"), ("ellipses", "ellipses"), ("roads", "roads")):
        shown = f"{MAP}.renderers.find((r) => r.name == '{name}').visible"
        assert browser.execute_script(f"return {shown}") is True
        before = pixels(browser, "map")
        click_legend(browser, label)
        wait(lambda shown=shown: browser.execute_script(f"return !{shown}"))
        wait(lambda before=before: pixels(browser, "map") != before)
        click_legend(browser, label)
        wait(lambda shown=shown: browser.execute_script(f"return {shown}"))
        wait(lambda before=before: pixels(browser, "map") == before)


def click_legend(driver, label):
    from selenium.webdriver.common.action_chains import ActionChains  # noqa: PLC0415

    place = driver.execute_script(
        """
        const find = (node) => {
          if (node.nodeType == 3) return node.textContent.includes(arguments[0]) ? node.parentElement : null
          for (const child of [...(node.shadowRoot?.childNodes ?? []), ...node.childNodes]) {
            if (child.nodeName == 'STYLE') continue
            const found = find(child)
            if (found) return found
          }
          return null
        }
        const box = find(document.querySelector('#gf-map')).getBoundingClientRect()
        return [box.left + box.width / 2, box.top + box.height / 2]
        """.replace("arguments[0]", json.dumps(label))
    )
    move_to(driver, place)
    ActionChains(driver).click().perform()


def test_a_tile_of_the_list_is_shown_on_the_map(browser):
    before = metres_a_pixel(browser)
    browser.execute_script("document.querySelector('button[data-box]').click()")
    wait(lambda: metres_a_pixel(browser)[0] != before[0])
    west, south, east, north = map(
        float, browser.execute_script("return document.querySelector('button[data-box]').dataset.box").split()
    )
    x0, x1, y0, y1, *_ = ranges(browser)
    assert x0 <= west < east <= x1
    assert y0 <= south < north <= y1


def test_no_error_and_nothing_from_the_net(browser):
    log = [entry for entry in browser.get_log("browser") if entry["level"] in ("WARNING", "SEVERE")]
    assert [entry for entry in log if entry["source"] != "rendering"] == []  # that one is about `pixels` above
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    asked = [m["params"]["request"]["url"] for m in messages if m["method"] == "Network.requestWillBeSent"]
    assert any(url.endswith("/report.html") for url in asked)
    assert not [url for url in asked if not url.startswith(("file:", "data:", "chrome:"))]
