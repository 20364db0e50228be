"""Rows of `detections` and `passes` of one run as the arrays that joint fusion takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from geofleet.algorithms.joint import Views
from geofleet.algorithms.joint_tracks import UNKNOWN_FRAME, Passes, Tracks, tracks_of_means
from geofleet.tables.schemas import GEOMETRY

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.geodesy import EnuFrame

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_UPPER = np.triu_indices(4)
INFORMATION = ("info_lon", "info_lat", "info_matrix", "info_vector", "info_s0", "info_dof")


@dataclass(frozen=True, slots=True)
class Assumed:
    """What is taken of a pass that declares nothing: standard deviations of its offset, an axis, and of its biases."""

    gnss_sigma_m: float
    range_bias_sigma_m: float
    bearing_bias_sigma_deg: float


@dataclass(frozen=True, slots=True, eq=False)
class Fleet:
    """One run as arrays; `pass_ids`, `kinds` and `classes` are the meaning of their codes."""

    tracks: Tracks
    view_xy: Floats
    passes: Passes
    views: Views | None
    pass_ids: tuple[str, ...]
    kinds: tuple[str, ...]


def fleet_arrays(
    detections: pa.Table, passes: pa.Table | None, *, class_code: Ints, frame: EnuFrame, assumed: Assumed
) -> Fleet:
    """Return one run as arrays in a local frame.

    Parameters
    ----------
    detections
        Usable rows of one run, sorted by pass and track; columns as `aggregate/tracks` writes them.
    passes
        Rows of `passes` of the run and its vehicles, or None: each pass is then one of its detections, and what it
        could have seen is not known.
    class_code
        (n,) class of each detection.
    assumed
        Stands for what passes do not declare.
    """
    reporting = detections["pass_id"].to_pylist()
    driven = [] if passes is None else passes["pass_id"].to_pylist()
    pass_ids = tuple(sorted({*reporting, *driven}))
    code = {name: at for at, name in enumerate(pass_ids)}
    declared, kinds = _declared(passes, pass_ids, assumed)
    pass_code = np.array([code[name] for name in reporting], np.int64)
    tracks, view_xy = _tracks(detections, pass_code, class_code, frame, declared)
    views = None if passes is None else _views(passes, code, frame)
    return Fleet(tracks, view_xy, declared, views, pass_ids, kinds)


def _declared(passes: pa.Table | None, pass_ids: tuple[str, ...], assumed: Assumed) -> tuple[Passes, tuple[str, ...]]:
    n = len(pass_ids)
    gnss = np.full(n, assumed.gnss_sigma_m)
    bias = np.tile([assumed.range_bias_sigma_m, np.deg2rad(assumed.bearing_bias_sigma_deg)], (n, 1))
    kind = np.full(n, "")
    if passes is not None:
        at = np.searchsorted(pass_ids, passes["pass_id"].to_pylist())
        gnss[at] = _or(passes, "gnss_sigma_m", assumed.gnss_sigma_m)
        bias[at, 0] = _or(passes, "range_bias_sigma_m", assumed.range_bias_sigma_m)
        bias[at, 1] = np.deg2rad(_or(passes, "bearing_bias_sigma_deg", assumed.bearing_bias_sigma_deg))
        kind = kind.astype(object)
        kind[at] = passes["sensor_kind"].to_pylist()
    kinds, kind_code = np.unique(kind.astype(str), return_inverse=True)
    return Passes(gnss, bias, kind_code.astype(np.int64)), tuple(kinds.tolist())


def _or(table: pa.Table, name: str, otherwise: float) -> Floats:
    """Return a column, or what stands for it where it is missing."""
    if name not in table.column_names:
        return np.full(table.num_rows, otherwise)
    return np.asarray(pc.fill_null(table[name].cast(pa.float64()), otherwise).to_numpy(), np.float64)


def _floats(table: pa.Table, name: str) -> Floats:
    """Return a column with NaN for null, or all NaN without it."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table[name].cast(pa.float64()).to_numpy(), np.float64)


def _tracks(
    detections: pa.Table, pass_code: Ints, class_code: Ints, frame: EnuFrame, declared: Passes
) -> tuple[Tracks, Floats]:
    n = detections.num_rows
    azimuth = np.pi / 2 - np.deg2rad(_floats(detections, "view_deg"))
    xy_m = frame.to_enu(_floats(detections, "lon"), _floats(detections, "lat"))
    spread = np.column_stack(
        (_floats(detections, "sigma_e_m") ** 2, _floats(detections, "sigma_n_m") ** 2, _floats(detections, "cov_en_m2"))
    )
    matrix, vector = tracks_of_means(
        xy_m,
        n_frames=_floats(detections, "n_frames"),
        spread=spread,
        range_m=_floats(detections, "range_mean_m"),
        azimuth_rad=azimuth,
        bias_sigma=declared.bias_sigma[pass_code],
    )
    s0, dof = np.zeros(n), np.zeros(n)
    informed = _informed(detections)
    if informed.any():
        rows = detections.filter(pa.array(informed))
        xy_m[informed] = frame.to_enu(_floats(rows, "info_lon"), _floats(rows, "info_lat"))
        upper = _lists(rows, "info_matrix", 10)
        full = np.zeros((len(upper), 4, 4))
        full[:, *_UPPER] = upper
        full[:, *_UPPER[::-1]] = upper
        matrix[informed], vector[informed] = full, _lists(rows, "info_vector", 4)
        s0[informed], dof[informed] = _or(rows, "info_s0", 0.0), _or(rows, "info_dof", 0.0)
    view_xy = np.nan_to_num(np.column_stack((np.cos(azimuth), np.sin(azimuth))))
    first, last = (_frames(detections, name) for name in ("frame_first", "frame_last"))
    return Tracks(pass_code, class_code, xy_m, matrix, vector, first, last, s0, dof), view_xy


def _informed(detections: pa.Table) -> NDArray[np.bool_]:
    """Return which rows bring a whole information form."""
    whole = np.ones(detections.num_rows, np.bool_)
    for name in INFORMATION[:4]:
        if name not in detections.column_names:
            return np.zeros(detections.num_rows, np.bool_)
        whole &= pc.is_valid(detections[name]).to_numpy()
    return whole


def _lists(table: pa.Table, name: str, length: int) -> Floats:
    values: Any = table[name].combine_chunks()
    return np.asarray(values.flatten().to_numpy(zero_copy_only=False), np.float64).reshape(-1, length)


def _frames(table: pa.Table, name: str) -> Ints:
    if name not in table.column_names:
        return np.full(table.num_rows, UNKNOWN_FRAME)
    # a copy, for Arrow's own memory is read-only: to numba that is another type, and all of the search compiles again
    return np.array(pc.fill_null(table[name].cast(pa.int64()), UNKNOWN_FRAME).to_numpy(), np.int64)


def _views(passes: pa.Table, code: dict[str, int], frame: EnuFrame) -> Views:
    """Return the paths of all passes, in the order of their codes; a pass that the table lacks has none."""
    order = np.argsort([code[name] for name in passes["pass_id"].to_pylist()], kind="stable")
    rows = passes.take(pa.array(order))
    vertices, owner = shapely.get_coordinates(shapely.from_wkb(rows[GEOMETRY].to_numpy()), return_index=True)
    at = np.array([code[name] for name in rows["pass_id"].to_pylist()])
    first = np.searchsorted(at[owner], np.arange(len(code) + 1))
    range_m, fov_deg = np.ones(len(code)), np.ones(len(code))
    range_m[at], fov_deg[at] = rows["range_m"].to_numpy(), rows["fov_deg"].to_numpy()
    return Views(frame.to_enu(*vertices.T), first, range_m, fov_deg)
