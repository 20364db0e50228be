"""Road reference lines as ASAM OpenDRIVE 1.1 to 1.8 defines them: from s along a road to x, y and heading.

A reference line is a chain of records (straight line, arc, clothoid, cubic), each of which starts at a pose of its own
and is a function of the distance ds along it. Lines and arcs are closed forms, clothoids Fresnel integrals; cubics are
polynomials of a parameter, which the arc length is inverted for where the format asks for it. Everything is in metres
and radians, x east and y north, headings counterclockwise from x, t positive to the left.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import fresnel

from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

N_PARAMETERS = 8
# A clothoid whose curvature changes by less than this share of itself a metre is integrated numerically: the Fresnel
# integrals would subtract nearly equal numbers there.
_NEARLY_ARC_PER_M = 1e-5
_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(64)
_PANEL_NODES, _PANEL_WEIGHTS = np.polynomial.legendre.leggauss(8)
_N_PANELS = 64
_MAX_NEWTON_STEPS = 30
_ENOUGH = 1e-10  # of a panel, and Newton's last step overshoots it by far
_MAX_POINTS_AT_ONCE = 8192


class Shape(IntEnum):
    """What a record of the plan view is, and what its parameters mean.

    LINE
        None.
    ARC
        Curvature in 1/m.
    SPIRAL
        Curvature at its start and end, linear in between.
    POLY3
        a, b, c, d of v(u) = a + bu + cu² + du³ in the frame of its start pose; ds is arc length.
    PARAM_POLY3_ARC_LENGTH
        aU, bU, cU, dU, aV, bV, cV, dV of u(p), v(p); p is ds, as the file promises.
    PARAM_POLY3_NORMALIZED
        The same with p from 0 to 1 and ds in proportion to the arc length, of which the record's length is the whole.
    """

    LINE = 0
    ARC = 1
    SPIRAL = 2
    POLY3 = 3
    PARAM_POLY3_ARC_LENGTH = 4
    PARAM_POLY3_NORMALIZED = 5


@dataclass(frozen=True, slots=True)
class PlanView:
    """The records of a reference line, sorted by s.

    Parameters
    ----------
    s
        Where each record starts along the road, m, shape (n,), n ≥ 1.
    x, y, heading
        Its start pose, m and radians, shape (n,).
    length
        Its length, m, shape (n,).
    shape
        Its `Shape`, shape (n,).
    parameters
        What the shape asks for, the rest 0, shape (n, 8).
    """

    s: Floats
    x: Floats
    y: Floats
    heading: Floats
    length: Floats
    shape: NDArray[np.int8]
    parameters: Floats

    @property
    def end_m(self) -> float:
        """Where the last record ends."""
        return float(self.s[-1] + self.length[-1])


@dataclass(frozen=True, slots=True)
class CubicProfile:
    """A quantity along a road (elevation, superelevation, lane offset, width): cubics in the distance from their start.

    Parameters
    ----------
    s
        Where each cubic starts, m, ascending, shape (n,); n may be 0.
    coefficients
        a, b, c, d of a + b·ds + c·ds² + d·ds³, shape (n, 4).
    """

    s: Floats
    coefficients: Floats

    def at(self, s: ArrayLike) -> Floats:
        """Return the quantity at s, same shape; 0 before the first cubic and where there is none."""
        at = np.asarray(s, np.float64)
        if not len(self.s):
            return np.zeros_like(at)
        index = np.searchsorted(self.s, at, side="right") - 1
        ds = at - self.s[index]
        a, b, c, d = np.moveaxis(self.coefficients[index], -1, 0)
        return np.where(index < 0, 0.0, a + ds * (b + ds * (c + ds * d)))


def no_profile() -> CubicProfile:
    """Return the profile that is 0 everywhere."""
    return CubicProfile(np.empty(0), np.empty((0, 4)))


@dataclass(frozen=True, slots=True)
class RoadPoints:
    """Points of a road: x, y in metres, z in metres, heading of the reference line there in radians; shape (n,)."""

    x: Floats
    y: Floats
    z: Floats
    heading: Floats


def reference_points(plan: PlanView, s: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return x, y and heading of a reference line.

    Parameters
    ----------
    plan
        The records of the line.
    s
        Distances along the road, m, shape (n,). A point between two records belongs to the one before it, one beyond
        either end to the nearest record, which is continued.

    Raises
    ------
    InputError
        The line has no records, or its numbers are too large to give a place.

    References
    ----------
    ASAM OpenDRIVE 1.8, chapter 9 (geometry).
    """
    at = np.atleast_1d(np.asarray(s, np.float64))
    if not len(plan.s):
        raise InputError("the reference line has no geometry.")
    record = np.maximum(np.searchsorted(plan.s, at, side="right") - 1, 0)
    ds = at - plan.s[record]
    u, v, turn = np.empty_like(at), np.empty_like(at), np.empty_like(at)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is told below
        for shape in np.unique(plan.shape[record]):
            for some in _batches(np.flatnonzero(plan.shape[record] == shape)):
                u[some], v[some], turn[some] = _local(plan, Shape(shape), record[some], ds[some])
        heading = plan.heading[record]
        cos, sin = np.cos(heading), np.sin(heading)
        x, y = plan.x[record] + u * cos - v * sin, plan.y[record] + u * sin + v * cos
    if not (np.isfinite(x).all() and np.isfinite(y).all() and np.isfinite(turn).all()):
        raise InputError("the numbers of the reference line are too large to give a place.")
    return x, y, heading + turn


def road_points(
    plan: PlanView,
    s: ArrayLike,
    t: ArrayLike,
    *,
    elevation: CubicProfile | None = None,
    superelevation: CubicProfile | None = None,
) -> RoadPoints:
    """Return the places of points given by s and t.

    The road's cross section is turned about the reference line by the superelevation (positive: the left side is
    higher), so that t counts along the tilted surface and moves a point by t·cos in plan and by t·sin in height.

    Parameters
    ----------
    plan
        The reference line.
    s, t
        Distance along it and to its left, m, shape (n,).
    elevation, superelevation
        Profiles in m and radians; none is 0.

    Raises
    ------
    InputError
        As `reference_points`.
    """
    at = np.atleast_1d(np.asarray(s, np.float64))
    x, y, heading = reference_points(plan, at)
    tilt = (superelevation or no_profile()).at(at)
    lateral = np.asarray(t, np.float64) * np.cos(tilt)
    z = (elevation or no_profile()).at(at) + np.asarray(t, np.float64) * np.sin(tilt)
    return RoadPoints(x - lateral * np.sin(heading), y + lateral * np.cos(heading), z, heading)


def sample_stations(plan: PlanView, start_m: float, end_m: float, *, step_m: float, extra: ArrayLike = ()) -> Floats:
    """Return values of s, ascending, that a line from `start_m` to `end_m` is drawn through.

    Both ends, the ends of all records in between and the `extra` stations are among them; no gap is wider than
    `step_m`.
    """
    knots = np.concatenate(([start_m, end_m], plan.s, np.asarray(extra, np.float64)))
    knots = np.unique(knots[(knots >= start_m) & (knots <= end_m)])
    n_steps = np.maximum(np.ceil(np.diff(knots) / step_m).astype(np.int64), 1)
    position = np.arange(n_steps.sum()) - np.repeat(np.cumsum(n_steps) - n_steps, n_steps)
    inner = np.repeat(knots[:-1], n_steps) + position * np.repeat(np.diff(knots) / n_steps, n_steps)
    return np.append(inner, knots[-1])


def _batches(index: Ints) -> list[Ints]:
    """Return the indices in runs: cubics and near arcs hold 64 numbers a point."""
    return np.array_split(index, max(1, -(-len(index) // _MAX_POINTS_AT_ONCE)))


def _local(plan: PlanView, shape: Shape, record: Ints, ds: Floats) -> tuple[Floats, Floats, Floats]:
    """Return u, v and the change of heading since the start of each record, at ds."""
    parameters = plan.parameters[record]
    if shape is Shape.LINE:
        return ds, np.zeros_like(ds), np.zeros_like(ds)
    if shape is Shape.ARC:
        return _arc(parameters[:, 0], ds)
    if shape is Shape.SPIRAL:
        rate = (parameters[:, 1] - parameters[:, 0]) / plan.length[record]
        return clothoid(parameters[:, 0], rate, ds)
    along, across, p = parameters[:, :4], parameters[:, 4:], ds
    if shape is Shape.POLY3:
        along, across = np.tile([0.0, 1.0, 0.0, 0.0], (len(ds), 1)), parameters[:, :4]
        p = _parameter_at(along, across, record, plan.length, ds)
    elif shape is Shape.PARAM_POLY3_NORMALIZED:
        p = _parameter_at(along, across, record, None, ds / plan.length[record])
    return _cubic(along, p), _cubic(across, p), np.arctan2(_slope(across, p), _slope(along, p))


def _arc(curvature: Floats, ds: Floats) -> tuple[Floats, Floats, Floats]:
    """Return u, v and turn on arcs: the chord has the direction of half the turn, and curvature may be 0."""
    half = curvature * ds / 2
    chord = ds * np.sinc(half / np.pi)
    return chord * np.cos(half), chord * np.sin(half), curvature * ds


def clothoid(curvature: ArrayLike, rate: ArrayLike, ds: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return u, v and turn on clothoids that start at the origin with heading 0.

    Parameters
    ----------
    curvature
        At the start, 1/m, shape (n,).
    rate
        Change of curvature, 1/m², shape (n,).
    ds
        Distance from the start, m, shape (n,).

    Notes
    -----
    u + iv = ∫ exp(i(κτ + rτ²/2)) dτ. With w = τ + κ/r the square is completed, and the integral is that of
    exp(irw²/2), a difference of Fresnel integrals scaled by √(π/|r|) (Abramowitz and Stegun, 7.3).
    """
    start, rate, ds = (np.atleast_1d(np.asarray(a, np.float64)) for a in np.broadcast_arrays(curvature, rate, ds))
    turn = start * ds + rate * ds**2 / 2
    is_fresnel = np.abs(rate) > _NEARLY_ARC_PER_M * np.abs(start)
    place = np.empty(len(ds), np.complex128)
    place[is_fresnel] = _by_fresnel(start[is_fresnel], rate[is_fresnel], ds[is_fresnel])
    rest = ~is_fresnel
    tau = ds[rest, None] * (_GAUSS_NODES + 1) / 2
    phase = start[rest, None] * tau + rate[rest, None] * tau**2 / 2
    place[rest] = ds[rest] / 2 * (np.exp(1j * phase) @ _GAUSS_WEIGHTS)
    return place.real, place.imag, turn


def _by_fresnel(start: Floats, rate: Floats, ds: Floats) -> NDArray[np.complex128]:
    """Return u + iv on clothoids whose curvature changes."""
    size = np.sqrt(np.pi / np.abs(rate))
    shift = start / rate
    (sin_1, cos_1), (sin_0, cos_0) = fresnel((ds + shift) / size), fresnel(shift / size)
    integral = size * (cos_1 - cos_0 + 1j * np.sign(rate) * (sin_1 - sin_0))
    return np.asarray(np.exp(-0.5j * start * shift) * integral, np.complex128)


def _cubic(coefficients: Floats, p: Floats) -> Floats:
    a, b, c, d = coefficients.T
    return np.asarray(a + p * (b + p * (c + p * d)), np.float64)


def _slope(coefficients: Floats, p: Floats) -> Floats:
    _, b, c, d = coefficients.T
    return np.asarray(b + p * (2 * c + p * 3 * d), np.float64)


def _speed(along: Floats, across: Floats, p: Floats) -> Floats:
    """Return the arc length gained a unit of the parameter; p has a column a value wanted."""
    u = along[:, 1, None] + p * (2 * along[:, 2, None] + 3 * p * along[:, 3, None])
    v = across[:, 1, None] + p * (2 * across[:, 2, None] + 3 * p * across[:, 3, None])
    return np.asarray(np.hypot(u, v), np.float64)


def _parameter_at(along: Floats, across: Floats, record: Ints, length: Floats | None, place: Floats) -> Floats:
    """Invert the arc length of cubics: return the parameter of points.

    The arc length at the ends of 64 panels brackets the answer; Newton's method, at most a panel a step, finds it.

    Parameters
    ----------
    along, across
        Coefficients of u and v of each point's record, shape (n, 4).
    record
        Record of each point, shape (n,).
    length
        Largest parameter by record, `place` being arc length in m; or None: the parameter ends at 1 and `place` is a
        share of the whole arc length. A record's length is rounded, its ends are not.
    place
        What to find the parameter of, shape (n,).
    """
    kept, first, of_point = np.unique(record, return_index=True, return_inverse=True)
    width = (np.ones(len(kept)) if length is None else length[kept]) / _N_PANELS
    nodes = (np.arange(_N_PANELS)[:, None] + (_PANEL_NODES + 1) / 2).ravel() * width[:, None]
    speed = _speed(along[first], across[first], nodes).reshape(len(kept), _N_PANELS, -1)
    reached = (np.cumsum(speed @ _PANEL_WEIGHTS, axis=1) * width[:, None] / 2)[of_point]
    width = width[of_point]
    target = place * reached[:, -1] if length is None else place
    panel = np.minimum((reached < target[:, None]).sum(axis=1), _N_PANELS - 1)
    rows = np.arange(len(place))
    before = np.where(panel > 0, reached[rows, panel - 1], 0.0)
    low = panel * width
    p = low + width * (target - before) / np.maximum(reached[rows, panel] - before, np.finfo(np.float64).tiny)
    for _ in range(_MAX_NEWTON_STEPS):
        part = (p - low)[:, None]
        arc = (_speed(along, across, low[:, None] + part * (_PANEL_NODES + 1) / 2) @ _PANEL_WEIGHTS) * part[:, 0] / 2
        step = (before + arc - target) / np.maximum(_speed(along, across, p[:, None])[:, 0], 1e-12)
        step = np.clip(step, -width, width)
        p = p - step
        if not (np.abs(step) > _ENOUGH * width).any():
            break
    return np.asarray(p, np.float64)
