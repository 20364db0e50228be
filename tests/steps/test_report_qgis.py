"""The QGIS project of a report, opened in a real QGIS as a user would, from a folder that was moved."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import zipfile
from xml.etree import ElementTree as ET

import pytest

from geofleet.config import load_config
from geofleet.formats.qgis import GROUND_STYLES, STYLES
from geofleet.steps.evaluate import evaluate
from geofleet.steps.report import report
from geofleet.steps.report.qgis import PROJECT
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import write_table
from geofleet.workflows.demo import run_demo

SYSTEM_PYTHON = "/usr/bin/python3"
DRAWN_FIRST = ["scores", "roads", "drives", "ellipses", "reference", "fused", "match_lines", "matches"]
# Opens a project, draws what its window would show, and tells what it found.
QGIS_SCRIPT = """
import json, os, sys
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor, QImage, QPainter
from qgis.core import QgsApplication, QgsExpression, QgsMapRendererCustomPainterJob, QgsMapSettings, QgsProject
app = QgsApplication([], False)
app.initQgis()
project = QgsProject.instance()
is_read = project.read(sys.argv[1])
view = project.viewSettings().defaultViewExtent()
settings = QgsMapSettings()
settings.setLayers(project.layerTreeRoot().checkedLayers())
settings.setDestinationCrs(project.crs())
settings.setTransformContext(project.transformContext())
settings.setExtent(view)
settings.setOutputSize(QSize(1000, 900))
image = QImage(QSize(1000, 900), QImage.Format_RGB32)
image.fill(QColor("white"))
painter = QPainter(image)
QgsMapRendererCustomPainterJob(settings, painter).renderSynchronously()
painter.end()
image.save(sys.argv[2])
colours = {image.pixelColor(x, y).name() for x in range(1000) for y in range(900)}
found = {
    "is_read": is_read,
    "title": project.title(),
    "crs": project.crs().authid(),
    "units": project.distanceUnits(),
    "view": [view.xMinimum(), view.yMinimum(), view.xMaximum(), view.yMaximum()],
    "view_crs": view.crs().authid(),
    "is_absolute": project.readBoolEntry("Paths", "/Absolute")[0],
    "order": [layer.id().removeprefix("geofleet_") for layer in project.layerTreeRoot().layerOrder()],
    "colours": sorted(colours),
    "layers": {},
}
for layer in project.mapLayers().values():
    rules = layer.renderer().rootRule().children() if layer.renderer().type() == "RuleRenderer" else []
    inside = QgsMapSettings()
    inside.setDestinationCrs(project.crs())
    extent = inside.layerExtentToOutputExtent(layer, layer.extent())
    found["layers"][layer.id().removeprefix("geofleet_")] = {
        "valid": layer.isValid(),
        "crs": layer.crs().authid(),
        "features": layer.featureCount(),
        "legend": [rule.label() for rule in rules],
        "tip": layer.mapTipTemplate(),
        "touches_view": view.intersects(extent),
    }
print(json.dumps(found), flush=True)
os._exit(0)  # QGIS may crash on taking its layers down, which is not what is tested here
"""


def open_in_qgis(project, picture):
    probe = [SYSTEM_PYTHON, "-c", "import qgis.core"]
    if not shutil.which(SYSTEM_PYTHON) or subprocess.run(probe, capture_output=True, check=False).returncode:  # noqa: S603 (fixed text)
        pytest.skip("QGIS (python3-qgis) is not on this machine")
    run = subprocess.run(  # noqa: S603 (fixed text)
        [SYSTEM_PYTHON, "-c", QGIS_SCRIPT, str(project), str(picture)],
        capture_output=True,
        check=True,
        text=True,
        env={"QT_QPA_PLATFORM": "offscreen", "HOME": str(picture.parent), "PATH": "/usr/bin:/bin"},
    )
    return json.loads(run.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def moved(tmp_path_factory):
    """Run the demo and move its folder: only relative paths survive that."""
    made = tmp_path_factory.mktemp("made") / "run"
    run_demo(made, n_vehicles=10)
    return shutil.move(made, tmp_path_factory.mktemp("moved") / "run")


@pytest.fixture(scope="module")
def seen(moved, tmp_path_factory):
    return open_in_qgis(moved / "qgis" / PROJECT, tmp_path_factory.mktemp("picture") / "project.png")


def document(project):
    with zipfile.ZipFile(project) as archive:
        (name,) = archive.namelist()
        return ET.fromstring(archive.read(name))  # noqa: S314 (our own file)


def test_paths_are_relative(moved):
    sources = [node.text for node in document(moved / "qgis" / PROJECT).iter("datasource")]
    assert len(sources) == len(DRAWN_FIRST)
    for source in sources:
        path = source.partition("|")[0]
        assert re.match(r"\.\.?/", path)
        assert (moved / "qgis" / path).is_file()


def test_every_layer_is_valid_and_styled(seen):
    assert seen["is_read"]
    assert set(seen["layers"]) == set(DRAWN_FIRST)
    for name, layer in seen["layers"].items():
        style = (STYLES | GROUND_STYLES)[name]
        assert layer["valid"], name
        assert layer["features"] > 0, name
        assert layer["crs"] == "EPSG:4326"
        assert layer["legend"] == [rule.label for rule in style.rules]
        assert all(column in layer["tip"] for column in style.tip)
        assert layer["touches_view"], name


def test_order_crs_and_extent(seen):
    assert seen["order"] == DRAWN_FIRST[::-1]
    assert seen["crs"] == seen["view_crs"] == "EPSG:32635"  # Helsinki lies in UTM zone 35
    assert not seen["is_absolute"]
    assert seen["title"] == "geofleet: Sign map of 10 simulated vehicles"
    west, south, east, north = seen["view"]
    assert 400 < east - west < 1500
    assert 400 < north - south < 1500


def test_the_picture_is_not_blank_and_has_every_colour(seen):
    assert len(seen["colours"]) > 100
    # found, false, missed, roads, drive, tiles
    assert {"#009e73", "#d55e00", "#0072b2", "#d0d0d0", "#000000"} <= set(seen["colours"])


def test_of_several_maps_one_is_shown(tmp_path, make_signs):
    xy, runs = [(0, 0), (50, 0), (0, 1)], ["a'b", "a'b", "c"]
    columns = {"run_id": runs, "method": "m", "n_vehicles": 3}
    write_table(SIGNS, make_signs(xy, ["stop"] * 3, **columns), tmp_path / "map.parquet")
    write_table(SIGNS, make_signs([(0, 0), (50, 0)], ["stop"] * 2), tmp_path / "reference.parquet")
    evaluate(tmp_path / "map.parquet", tmp_path / "reference.parquet", tmp_path / "evaluation", config=load_config())
    report(tmp_path, tmp_path / "report", run_id="a'b")
    seen = open_in_qgis(tmp_path / "qgis" / PROJECT, tmp_path / "project.png")
    assert {name: layer["features"] for name, layer in seen["layers"].items()} == {
        "matches": 2,
        "match_lines": 0,
        "fused": 2,
        "reference": 2,
        "ellipses": 0,
        "scores": 1,
    }
    assert all(layer["valid"] for layer in seen["layers"].values())
