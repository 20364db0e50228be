"""Make `geofleet/formats/country_outlines.json` from Natural Earth's countries, 1:110 million (public domain).

Outlines are widened by a margin that covers what the scale leaves out of coasts and borders, and simplified. Islands
that the scale leaves out as a whole are added as boxes. The source came with geopandas up to 0.14:

    pip download --no-deps geopandas==0.14.4 && unzip geopandas-0.14.4-*.whl
    python scripts/outline_countries.py geopandas/datasets/naturalearth_lowres/naturalearth_lowres.shp
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pyogrio
import shapely

from geofleet.formats.countries import country_code

MARGIN_DEG, TOLERANCE_DEG, DIGITS = 0.3, 0.08, 2
OUT = Path(__file__).parents[1] / "geofleet" / "formats" / "country_outlines.json"
# West, south, east, north
ISLANDS = {
    "DK": [(14.6, 54.9, 15.3, 55.4)],
    "EE": [(21.6, 57.8, 23.6, 59.2)],
    "ES": [(-18.3, 27.5, -13.3, 29.5), (1.0, 38.5, 4.5, 40.2), (-5.5, 35.1, -2.8, 36.0)],
    "FI": [(19.2, 59.6, 22.5, 60.7)],
    "FR": [(55.1, -21.5, 55.9, -20.8), (-61.9, 14.3, -60.7, 16.6), (44.9, -13.1, 45.4, -12.5)],
    "GB": [(-7.8, 56.2, -5.6, 58.6), (-3.6, 58.6, -0.6, 60.9), (-6.5, 49.8, -5.1, 50.3)],
    "GR": [(22.8, 34.7, 28.4, 40.6), (19.3, 37.5, 21.5, 39.9)],
    "HK": [(113.7, 22.1, 114.5, 22.6)],
    "IT": [(11.8, 35.3, 15.3, 38.9), (10.0, 42.2, 11.2, 43.1)],
    "JP": [(122.8, 24.0, 131.4, 31.0), (128.5, 32.5, 130.2, 34.8)],
    "LI": [(9.4, 47.0, 9.7, 47.3)],
    "MC": [(7.3, 43.6, 7.5, 43.8)],
    "MT": [(14.1, 35.7, 14.7, 36.2)],
    "MU": [(57.2, -20.6, 57.9, -19.9)],
    "NO": [(11.5, 67.0, 16.5, 69.5)],
    "PT": [(-31.4, 36.8, -24.9, 39.8), (-17.4, 32.3, -16.2, 33.2)],
    "SE": [(17.9, 56.8, 19.4, 58.1), (16.2, 56.0, 17.4, 57.5)],
    "SG": [(103.5, 1.1, 104.2, 1.6)],
    "BH": [(50.3, 25.7, 50.9, 26.4)],
}


def main() -> None:
    """Read the countries and write their outlines."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("source", type=Path)
    given = options.parse_args()
    frame = pyogrio.read_dataframe(given.source)
    outlines = {}
    for code3, shape in zip(frame["iso_a3"], frame.geometry, strict=True):
        code = country_code(code3)
        if code:
            parts = [shape.buffer(MARGIN_DEG, quad_segs=2), *(shapely.box(*box) for box in ISLANDS.pop(code, ()))]
            outlines[code] = shapely.union_all(parts)
    outlines |= {code: shapely.union_all([shapely.box(*box) for box in boxes]) for code, boxes in ISLANDS.items()}
    rings = {code: [plain(part) for part in shapely.get_parts(shape)] for code, shape in sorted(outlines.items())}
    lines = ",\n".join(
        f"{json.dumps(code)}: {json.dumps(found, separators=(',', ':'))}" for code, found in rings.items()
    )
    OUT.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def plain(part: shapely.Polygon) -> list[list[float]]:
    """Return the outer ring, simplified; holes are other countries or lakes, and do not matter to a margin."""
    ring = shapely.Polygon(part.exterior).simplify(TOLERANCE_DEG).exterior
    return [[round(x, DIGITS), round(y, DIGITS)] for x, y in ring.coords]


if __name__ == "__main__":
    main()
