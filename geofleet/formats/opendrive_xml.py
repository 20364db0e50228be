"""The parts of an OpenDRIVE file that signals and lanes share: its roads one by one, and their geometry."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.road_geometry import N_PARAMETERS, CubicProfile, PlanView, Shape
from geofleet.errors import InputError
from geofleet.formats.xml import iter_elements, number, place, text_of

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

ROOT = "OpenDRIVE"
# Bulky and of no use here: extensions, surfaces, outlines, the links between lanes
_UNUSED = frozenset({"userData", "include", "dataQuality", "surface", "outline", "outlines", "markings", "borders"}) | {
    *("material", "railroad", "link", "parkingSpace")
}
_ORDER = ("a", "b", "c", "d")
_PARAM_ORDER = ("aU", "bU", "cU", "dU", "aV", "bV", "cV", "dV")
_MAX_ROAD_M = 2e5


@dataclass(frozen=True, slots=True)
class Road:
    """Geometry of a road: reference line, profiles of height and tilt, length in metres (that of the line itself)."""

    road_id: str
    plan: PlanView
    elevation: CubicProfile
    superelevation: CubicProfile
    length_m: float


def header_and_roads(path: Path, without: Collection[str]) -> Iterator[Element]:
    """Yield the header and the roads of a file, without what no reader needs and without some more tags.

    Raises
    ------
    InputError
        As `iter_elements`; the file has another root.
    """
    return iter_elements(path, ("header", "road"), root=ROOT, without=_UNUSED | set(without))


@contextmanager
def in_road(element: Element) -> Iterator[None]:
    """Name the road in an InputError that arises inside of it."""
    try:
        yield
    except InputError as error:
        here = f'road "{element.get("id", "")[:40]}"'
        where = f"{error.where}, {here}" if error.where else f"{place(element).partition(':')[0]}: {here}"
        raise InputError(error.what, where=where, todo=error.todo) from None


def read_road(element: Element) -> Road:
    """Return the geometry of a road.

    Raises
    ------
    InputError
        An attribute is missing or no number, a geometry is of unknown kind, or there is none.
    """
    plan = _plan_view(element)
    length = number(element, "length", plan.end_m)
    if not 0 <= length <= _MAX_ROAD_M:
        raise InputError(f"length={length:g} m is no length of a road.", where=place(element))
    return Road(
        text_of(element, "id"),
        plan,
        profile(children(element, "elevationProfile", "elevation")),
        profile(children(element, "lateralProfile", "superelevation")),
        plan.end_m,
    )


def children(element: Element, container: str, tag: str) -> list[Element]:
    """Return the elements of a tag in a container of an element; none when the container is absent."""
    found = element.find(container)
    return [] if found is None else found.findall(tag)


def profile(elements: Sequence[Element], name: str = "s", start_m: float = 0.0) -> CubicProfile:
    """Return cubics as a profile, sorted by the attribute `name`, which counts from `start_m`.

    Raises
    ------
    InputError
        An attribute is missing or no number.
    """
    s = np.array([start_m + number(element, name) for element in elements], np.float64)
    rows = [[number(element, key) for key in _ORDER] for element in elements]
    coefficients = np.array(rows, np.float64).reshape(-1, len(_ORDER))
    order = np.argsort(s, kind="stable")
    return CubicProfile(s[order], coefficients[order])


def _plan_view(road: Element) -> PlanView:
    """Return the reference line; records of no length, which exporters leave behind, take no part in it."""
    records = children(road, "planView", "geometry")
    if not records:
        raise InputError("the road has no planView with a geometry.", where=place(road))
    poses = np.array([[number(r, key) for key in ("s", "x", "y", "hdg", "length")] for r in records], np.float64)
    shapes = [_shape(record) for record in records]
    length = poses[:, 4]
    for record in (records[i] for i in np.flatnonzero((length < 0) | (length > _MAX_ROAD_M))):
        raise InputError(f"length={record.get('length')} is no length of a geometry.", where=place(record))
    if poses[:, 0].min() < -_MAX_ROAD_M or (poses[:, 0] + length).max() > _MAX_ROAD_M:
        raise InputError(f"s of the geometry goes beyond {_MAX_ROAD_M / 1000:g} km.", where=place(road))
    order = np.argsort(poses[:, 0], kind="stable")
    order = order[length[order] > 0] if (length > 0).any() else order[:1]
    if not (length > 0).any():
        raise InputError("the reference line has no length.", where=place(road))
    s, x, y, heading, length = poses[order].T
    kind = np.array([shapes[i][0] for i in order], np.int8)
    parameters = np.zeros((len(order), N_PARAMETERS))
    for row, i in enumerate(order):
        given = shapes[i][1]
        parameters[row, : len(given)] = given
    return PlanView(s, x, y, heading, length, kind, parameters)


def _shape(record: Element) -> tuple[Shape, list[float]]:
    """Return the shape of a geometry record and its parameters."""
    for child in record:
        if child.tag == "line":
            return Shape.LINE, []
        if child.tag == "arc":
            return Shape.ARC, [number(child, "curvature")]
        if child.tag == "spiral":
            return Shape.SPIRAL, [number(child, "curvStart"), number(child, "curvEnd")]
        if child.tag == "poly3":
            return Shape.POLY3, [number(child, key) for key in _ORDER]
        if child.tag == "paramPoly3":
            return _param_shape(child), [number(child, key) for key in _PARAM_ORDER]
    kinds = ", ".join(f"<{child.tag[:40]}>" for child in record) or "nothing"
    raise InputError(
        f"unknown geometry: {kinds}.",
        where=place(record),
        todo="A geometry holds one of line, arc, spiral, poly3, paramPoly3.",
    )


def _param_shape(cubic: Element) -> Shape:
    """Return what p is: without `pRange` it runs from 0 to 1 (ASAM OpenDRIVE 1.4 to 1.8)."""
    p_range = cubic.get("pRange", "normalized").strip()
    if p_range in {"normalized", ""}:
        return Shape.PARAM_POLY3_NORMALIZED
    if p_range == "arcLength":
        return Shape.PARAM_POLY3_ARC_LENGTH
    raise InputError(f'pRange="{p_range[:40]}" is unknown.', where=place(cubic), todo="It is arcLength or normalized.")
