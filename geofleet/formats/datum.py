"""How the coordinates of a file came to WGS 84: by which operation, how well, and what to be told about it.

Datums that are fixed to a continent (ETRS89, NAD83, GDA) drift away from WGS 84 by centimetres a year and are up to a
metre or two off by now. PROJ takes most of them for equal; that is a choice, so it is said.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.formats.reading import WGS84, Datum

if TYPE_CHECKING:
    from numpy.typing import NDArray
    from pyproj import CRS, Transformer

    Floats = NDArray[np.float64]

_WGS84 = "World Geodetic System 1984"
_SHIFTS = ("helmert", "gridshift", "molodensky", "molobadekas", "deformation", "tinshift")
_AXES = ("axis order change (2D) + ", " + axis order change (2D)")


def datum_of(crs: Any, lon: Floats, lat: Floats) -> Datum:
    """Return how points of a CRS were brought to longitude and latitude, as PROJ does it in the middle of them.

    Parameters
    ----------
    crs
        In any form that pyproj takes, and known to it.
    lon, lat
        The points in OGC:CRS84, degrees, shape (n,): PROJ's choice depends on the place.
    """
    known = np.isfinite(lon) & np.isfinite(lat)
    middle = (float(np.median(lon[known])), float(np.median(lat[known]))) if known.any() else (0.0, 0.0)
    return _datum_at(crs if isinstance(crs, str) else crs.srs, *middle)


def local_datum(name: str) -> Datum:
    """Return the datum of coordinates that count from a point given in WGS 84."""
    return Datum(name, "none needed: metres from a point given in WGS 84", 0.0)


@lru_cache(maxsize=256)
def _datum_at(text: str, lon: float, lat: float) -> Datum:
    from pyproj import CRS, Transformer  # noqa: PLC0415  (takes a moment to load)

    crs = CRS.from_user_input(text)
    name = _name(crs, text)
    if crs.geodetic_crs is not None and _is_wgs84(crs):
        return Datum(name, "none needed: WGS 84 itself" if crs.is_geographic else "projection only", 0.0)
    description, definition, accuracy_m = _operation(Transformer.from_crs(crs, WGS84.crs, always_xy=True), lon, lat)
    doubt = ""
    if "Ballpark" in description:
        doubt = "the file does not name a datum that PROJ can relate to WGS 84, so none was applied"
    elif not any(shift in definition for shift in _SHIFTS):
        doubt = f"{_datum_name(crs)} is taken as equal to WGS 84 (a null transformation)"
    return Datum(name, description, accuracy_m, f"{doubt}; the two can differ by up to a metre or two" if doubt else "")


def _operation(transformer: Transformer, lon: float, lat: float) -> tuple[str, str, float | None]:
    """Return description, definition and accuracy, m, of the operation that PROJ uses at a place."""
    from pyproj.exceptions import ProjError  # noqa: PLC0415  (as above)

    used = transformer
    try:
        x, y = transformer.transform(lon, lat, direction="INVERSE")
        transformer.transform(x, y)
        used = transformer.get_last_used_operation()
    except ProjError:  # there was but one operation to choose
        pass
    description = str(used.description)
    for axes in _AXES:
        description = description.replace(axes, "")
    return description, str(used.definition), used.accuracy if used.accuracy >= 0 else None


def _is_wgs84(crs: CRS) -> bool:
    geodetic = crs.geodetic_crs
    return not crs.is_bound and geodetic is not None and _WGS84 in _datum_name(crs)


def _datum_name(crs: CRS) -> str:
    geodetic = crs.geodetic_crs
    return str(geodetic.datum.name) if geodetic is not None and geodetic.datum is not None else crs.name


def _name(crs: CRS, text: str) -> str:
    """Return the name of a CRS with its code, or what was given when it has none."""
    code = ":".join(crs.to_authority() or ())
    if crs.name in {"", "unknown"}:
        return text[:120]
    return str(crs.name) if not code else code if code == WGS84.crs else f"{crs.name} ({code})"
