"""Write the pictures of the README from a finished demo: its map, and the page as a browser shows it.

Run: make demo && python scripts/write_pictures.py     (needs Debian's chromium and chromium-driver)
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from selenium import webdriver
from selenium.webdriver.chrome.options import Options
from selenium.webdriver.chrome.service import Service
from selenium.webdriver.common.action_chains import ActionChains

REPO = Path(__file__).resolve().parents[1]
REPORT, DOCS = REPO / "data" / "processed" / "report", REPO / "docs"
FLAGS = ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=1180,1480", "--hide-scrollbars")
PATIENCE_S = 60
# Where a found sign is in the window.
PLACE = """
const plot = Bokeh.documents[0].get_model_by_name('map')
const view = Bokeh.index.get_one(plot)
const box = view.el.getBoundingClientRect()
const data = plot.renderers.find((r) => r.name == 'TP').data_source.data
const [x, y, frame] = [plot.x_range, plot.y_range, view.frame.bbox]
return [
  box.left + frame.left + (data.x[0] - x.start) / (x.end - x.start) * frame.width,
  box.top + frame.top + (y.end - data.y[0]) / (y.end - y.start) * frame.height,
]
"""


def main() -> None:
    """Write both pictures."""
    if not (REPORT / "report.html").is_file():
        sys.exit("run `make demo` first")
    shutil.copyfile(REPORT / "map.png", DOCS / "demo.png")
    with TemporaryDirectory() as profile:
        options = Options()
        options.binary_location = shutil.which("chromium") or "chromium"
        for flag in (*FLAGS, f"--user-data-dir={profile}"):
            options.add_argument(flag)
        browser = webdriver.Chrome(options=options, service=Service(shutil.which("chromedriver") or "chromedriver"))
        try:
            photograph(browser)
        finally:
            browser.quit()


def photograph(browser: webdriver.Chrome) -> None:
    """Open the page, point at a found sign and save what is seen."""
    browser.get((REPORT / "report.html").as_uri())
    end = time.monotonic() + PATIENCE_S
    while not browser.execute_script("return document.documentElement.dataset.ready") and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(2)
    chain = ActionChains(browser)
    x, y = browser.execute_script(PLACE)
    chain.w3c_actions.pointer_action.move_to_location(round(x), round(y))  # type: ignore[no-untyped-call]
    chain.perform()
    time.sleep(2)
    browser.save_screenshot(str(DOCS / "report.png"))


if __name__ == "__main__":
    main()
