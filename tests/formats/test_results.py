from __future__ import annotations

import json
import shutil
import sqlite3
import subprocess
from contextlib import closing

import geopandas
import numpy as np
import pytest
import shapely

from geofleet.config import load_config
from geofleet.formats.geopackage import write_geopackage
from geofleet.formats.qgis import STYLES
from geofleet.formats.results import GEOMETRY_TYPES
from geofleet.steps.evaluate import evaluate
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import write_table

SYSTEM_PYTHON = "/usr/bin/python3"
# Loads every layer the way a user's double click does, and draws it alone on white.
QGIS_SCRIPT = """
import json, os, sys
from pathlib import Path
from qgis.PyQt.QtCore import QSize
from qgis.PyQt.QtGui import QColor, QImage, QPainter
from qgis.core import QgsApplication, QgsExpression, QgsMapRendererCustomPainterJob, QgsMapSettings, QgsVectorLayer
folder = Path(sys.argv[1])
app = QgsApplication([], False)
app.initQgis()
found = {}
for name in sys.argv[2:]:
    for kind, uri in (("geojson", f"{folder}/{name}.geojson"), ("gpkg", f"{folder}/results.gpkg|layername={name}")):
        layer = QgsVectorLayer(uri, name, "ogr")
        settings = QgsMapSettings()
        settings.setLayers([layer])
        settings.setDestinationCrs(layer.crs())
        settings.setExtent(layer.extent().buffered(0.0002))
        settings.setOutputSize(QSize(200, 200))
        image = QImage(QSize(200, 200), QImage.Format_RGB32)
        image.fill(QColor("white"))
        painter = QPainter(image)
        QgsMapRendererCustomPainterJob(settings, painter).renderSynchronously()
        painter.end()
        colours = {image.pixelColor(x, y).name() for x in range(200) for y in range(200)}
        is_styled = layer.renderer().type() == "RuleRenderer"
        rules = layer.renderer().rootRule().children() if is_styled else []
        found[f"{name} {kind}"] = {
            "valid": layer.isValid(),
            "crs": layer.crs().authid(),
            "features": layer.featureCount(),
            "legend": [rule.label() for rule in rules],
            "faults": [
                rule.filterExpression()
                for rule in rules
                if rule.filterExpression() and QgsExpression(rule.filterExpression()).hasParserError()
            ],
            "title": layer.displayExpression(),
            "colours": sorted(colours),
        }
print(json.dumps(found), flush=True)
os._exit(0)  # QGIS may crash on taking its layers down, which is not what is tested here
"""


@pytest.fixture(scope="module")
def out(tmp_path_factory, make_signs):
    """Evaluate a map with every outcome; s3 has no covariance."""
    folder = tmp_path_factory.mktemp("results")
    map_ = make_signs(
        [(1, 0), (40.5, 20), (80, 5), (120, 0), (1500, 0)],
        ["stop", "yield", "stop", "stop", "stop"],
        var_e_m2=[4.0, 1.0, 0.25, None, 1.0],
        var_n_m2=[1.0, 1.0, 0.25, None, 1.0],
        cov_en_m2=[1.0, 0.0, 0.0, None, 0.0],
        height_m=[2.5, None, None, None, None],
        n_passes=[7, None, None, None, None],
    )
    reference = make_signs([(0, 0), (40, 20), (80, 60), (120, 0)], ["stop"] * 4)
    write_table(SIGNS, map_, folder / "map.parquet")
    write_table(SIGNS, reference, folder / "reference.parquet")
    return evaluate(folder / "map.parquet", folder / "reference.parquet", folder / "out", config=load_config()).out


def positions(geometry):
    """Return every position of a GeoJSON geometry."""
    coordinates = geometry["coordinates"]
    if geometry["type"] == "Point":
        return [coordinates]
    return coordinates if geometry["type"] == "LineString" else [p for ring in coordinates for p in ring]


@pytest.mark.parametrize("layer", GEOMETRY_TYPES)
def test_geojson_follows_rfc_7946(out, layer):
    document = json.loads((out / f"{layer}.geojson").read_text(encoding="utf-8"))
    assert document["type"] == "FeatureCollection"
    assert "crs" not in document  # section 4: always WGS 84
    assert document["features"]
    for feature in document["features"]:
        assert set(feature) >= {"type", "geometry", "properties"}
        assert feature["type"] == "Feature"
        geometry = feature["geometry"]
        assert geometry["type"] == GEOMETRY_TYPES[layer]
        assert not {"coordinates", "geometries", "features"} & set(feature)  # section 7.1
        for position in positions(geometry):
            lon, lat = position  # never a third number
            assert 24.9 < lon < 25.0
            assert 60.1 < lat < 60.2
        if geometry["type"] == "Polygon":
            for number, ring in enumerate(geometry["coordinates"]):
                assert len(ring) >= 4
                assert ring[0] == ring[-1]
                assert shapely.LinearRing(ring).is_ccw == (number == 0)  # section 3.1.6
            assert shapely.Polygon(*geometry["coordinates"][:1]).is_valid


@pytest.mark.parametrize("layer", GEOMETRY_TYPES)
def test_missing_values_are_null_and_every_feature_has_the_same_properties(out, layer):
    text = (out / f"{layer}.geojson").read_text(encoding="utf-8")
    features = json.loads(text, parse_constant=pytest.fail)["features"]  # NaN and Infinity are not JSON
    assert len({tuple(feature["properties"]) for feature in features}) == 1
    ids = {"scores": "tile", "matches": "outcome", "match_lines": "ref_id"}.get(layer, "sign_id")
    assert all(feature["properties"][ids] for feature in features)


def test_nulls_stay_nulls(out):
    features = json.loads((out / "fused.geojson").read_text())["features"]
    by_id = {f["properties"]["sign_id"]: f["properties"] for f in features}
    assert by_id["s3"]["var_e_m2"] is None
    assert by_id["s0"]["height_m"] == 2.5
    assert by_id["s1"]["height_m"] is None
    assert (repr(by_id["s0"]["n_passes"]), by_id["s1"]["n_passes"]) == ("7", None)
    outcomes = [f["properties"] for f in json.loads((out / "matches.geojson").read_text())["features"]]
    assert [p["class_agrees"] for p in outcomes if p["outcome"] == "TP"] == [True, True]
    assert {p["class_agrees"] for p in outcomes if p["outcome"] != "TP"} == {None}
    assert all((p["distance_m"] is None) == (p["outcome"] != "TP") for p in outcomes)


def test_ellipses_are_those_of_the_covariances(out):
    ellipses = geopandas.read_file(out / "ellipses.geojson").set_index("sign_id")
    assert ellipses.index.tolist() == ["s0", "s1", "s2", "s4"]
    metres = ellipses.to_crs(3879)
    # pi q sqrt(det) with q = 5.991 (95 % of chi² with two degrees of freedom); 48 corners lose 0.3 %
    for sign, determinant in (("s0", 3.0), ("s1", 1.0), ("s2", 0.0625)):
        assert metres.geometry[sign].area == pytest.approx(np.pi * 5.9915 * determinant**0.5, rel=0.004)
    assert ellipses.loc["s1", ["semi_major_m", "semi_minor_m"]].tolist() == pytest.approx([2.4477, 2.4477], abs=1e-4)


def test_the_geopackage_holds_the_same_features(out):
    with closing(sqlite3.connect(out / "results.gpkg")) as package:
        contents = dict(package.execute("SELECT table_name, data_type FROM gpkg_contents"))
        assert package.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert package.execute("SELECT DISTINCT last_change FROM gpkg_contents").fetchall() == [
            ("2000-01-01T00:00:00.000Z",)
        ]
        styles = dict(package.execute("SELECT f_table_name, styleQML FROM layer_styles WHERE useAsDefault"))
    assert contents == dict.fromkeys(GEOMETRY_TYPES, "features") | {"layer_styles": "attributes"}
    for layer, geometry_type in GEOMETRY_TYPES.items():
        packaged = geopandas.read_file(out / "results.gpkg", layer=layer)
        loose = geopandas.read_file(out / f"{layer}.geojson")
        assert set(packaged.geom_type) == {geometry_type}
        assert packaged.crs.to_epsg() == 4326
        assert list(packaged.columns) == list(loose.columns)
        assert len(packaged) == len(loose)
        assert styles[layer] == (out / f"{layer}.qml").read_text(encoding="utf-8") == STYLES[layer].qml()


def test_a_geopackage_of_empty_layers_keeps_their_types(tmp_path):
    empty = geopandas.GeoDataFrame({"sign_id": []}, geometry=[], crs="OGC:CRS84")
    write_geopackage({"reference": (empty, "Point"), "scores": (empty, "Polygon")}, tmp_path / "empty.gpkg")
    with closing(sqlite3.connect(tmp_path / "empty.gpkg")) as package:
        types = dict(package.execute("SELECT table_name, geometry_type_name FROM gpkg_geometry_columns"))
    assert types == {"reference": "POINT", "scores": "POLYGON"}
    assert [path.name for path in tmp_path.iterdir()] == ["empty.gpkg"]


def test_styles_name_columns_that_their_layers_have(out):
    for layer, style in STYLES.items():
        columns = set(geopandas.read_file(out / f"{layer}.geojson").columns)
        assert {style.title, *style.tip} <= columns


def test_outcomes_differ_in_colour_and_in_shape():
    rules = STYLES["matches"].rules
    assert len({rule.options["name"] for rule in rules}) == len({rule.options["outline_color"] for rule in rules}) == 3


@pytest.fixture(scope="module")
def seen_by_qgis(out):
    probe = [SYSTEM_PYTHON, "-c", "import qgis.core"]
    if not shutil.which(SYSTEM_PYTHON) or subprocess.run(probe, capture_output=True, check=False).returncode:  # noqa: S603 (fixed text)
        pytest.skip("QGIS (python3-qgis) is not on this machine")
    run = subprocess.run(  # noqa: S603 (fixed text)
        [SYSTEM_PYTHON, "-c", QGIS_SCRIPT, str(out), *GEOMETRY_TYPES],
        capture_output=True,
        check=True,
        text=True,
        env={"QT_QPA_PLATFORM": "offscreen", "HOME": str(out.parent), "PATH": "/usr/bin:/bin"},
    )
    return json.loads(run.stdout.splitlines()[-1])


@pytest.mark.parametrize("kind", ["geojson", "gpkg"])
@pytest.mark.parametrize("layer", GEOMETRY_TYPES)
def test_qgis_opens_every_layer_styled(seen_by_qgis, out, layer, kind):
    found = seen_by_qgis[f"{layer} {kind}"]
    assert found["valid"]
    assert found["crs"] == "EPSG:4326"
    assert found["features"] == len(geopandas.read_file(out / f"{layer}.geojson"))
    assert found["legend"] == [rule.label for rule in STYLES[layer].rules]
    assert found["faults"] == []
    assert found["title"] == f'"{STYLES[layer].title}"'
    assert len(found["colours"]) > 1  # not blank


@pytest.mark.parametrize("kind", ["geojson", "gpkg"])
def test_qgis_draws_every_outcome_in_its_colour(seen_by_qgis, kind):
    assert {"#009e73", "#d55e00", "#0072b2"} <= set(seen_by_qgis[f"matches {kind}"]["colours"])
