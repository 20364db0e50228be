"""Where everything of a run lies, in metres of one East-North-Up frame, and what is said about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.tiling import quadkey_bounds
from geofleet.tables.schemas import BBOX, GEOMETRY
from geofleet.tables.store import lonlat

if TYPE_CHECKING:
    import pandas as pd
    import pyarrow as pa
    from geopandas import GeoDataFrame
    from numpy.typing import NDArray

    from geofleet.steps.report.contents import Contents

    Floats = NDArray[np.float64]

MOST_SIGNS = 20_000  # what a browser pans smoothly; of larger maps the worst tiles are drawn
MOST_TILES = 5_000
_MARGIN_M = 60.0
_CHI2_95 = 5.991464547107979  # 95 % quantile of chi-squared with two degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A map and its reference as arrays in metres.

    Parameters
    ----------
    outcomes
        A row a sign of either layer: `outcome`, `x`, `y` (an FP at its own place, all others at the reference sign),
        `sign`, `sign_class`, `distance`, `evidence` (texts), and `east_m`, `north_m`, `distance_m`: the error of a TP.
    n_outcomes, n_tiles
        Before those of better tiles were left out.
    fused_xy, reference_xy
        (n, 2) positions of the signs of either layer.
    lines
        (k, 2, 2) from the sign of the map to its reference.
    ellipses, roads, drives
        Rings and lines, each (n, 2).
    tiles
        Rows of `scores`, each with its `ring`; the worst first.
    extent
        Smallest and largest east and north of what is scored and driven, with a margin.
    distance_m, shift_m
        (n,) errors of all found signs, and their mean error east and north; None when none was found.
    n_inside, n_with_ellipse
        Found signs whose reference lies in their 95 % ellipse, and found signs that have a covariance.
    """

    outcomes: pd.DataFrame
    n_outcomes: int
    n_tiles: int
    fused_xy: Floats
    reference_xy: Floats
    lines: Floats
    ellipses: list[Floats]
    roads: list[Floats]
    drives: list[Floats]
    tiles: list[dict[str, Any]]
    extent: tuple[Floats, Floats]
    distance_m: Floats
    shift_m: tuple[float, float] | None
    n_inside: int
    n_with_ellipse: int

    @property
    def found(self) -> pd.DataFrame:
        """The drawn outcomes that are a TP."""
        return self.outcomes[self.outcomes["outcome"] == "TP"]


def lay_out(contents: Contents) -> Scene:
    """Bring a run into the frame around its signs."""
    frame = EnuFrame.around(*(_lonlats(contents)))
    outcomes = _outcomes(contents, frame)
    drives = _drives(contents.drives, frame)
    drawn = _worst(outcomes, contents.tiles)
    shown = set(drawn["fused_id"].dropna()), set(drawn["ref_id"].dropna())
    fused = contents.fused[contents.fused["sign_id"].isin(shown[0])]
    texts = dict(zip(fused["sign_id"], _evidence(fused), strict=True))
    drawn["evidence"] = [texts.get(name, "not in the map") for name in drawn["fused_id"]]
    reference = contents.reference[contents.reference["sign_id"].isin(shown[1])]
    ellipses = contents.ellipses[contents.ellipses["sign_id"].isin(shown[0])]
    extent = _extent([drawn[["x", "y"]].to_numpy(float), *drives])
    found = outcomes[outcomes["outcome"] == "TP"]
    inside = found["mahalanobis_sq"].dropna() <= _CHI2_95
    start = drawn.loc[drawn["outcome"] == "TP", ["x", "y"]].to_numpy(float)
    error = drawn.loc[drawn["outcome"] == "TP", ["east_m", "north_m"]].to_numpy(float)
    return Scene(
        outcomes=drawn,
        n_outcomes=len(outcomes),
        n_tiles=len(contents.tiles),
        fused_xy=_xy(fused, frame),
        reference_xy=_xy(reference, frame),
        lines=np.stack((start + error, start), axis=1),
        ellipses=_split(ellipses.geometry.exterior.to_numpy(), frame),
        roads=_roads(contents.lanes, frame, extent),
        drives=drives,
        tiles=[tile | {"ring": _ring(tile["tile"], frame)} for tile in contents.tiles[:MOST_TILES]],
        extent=extent,
        distance_m=found["distance_m"].to_numpy(float),
        shift_m=(float(found["east_m"].mean()), float(found["north_m"].mean())) if len(found) else None,
        n_inside=int(inside.sum()),
        n_with_ellipse=len(inside),
    )


def _lonlats(contents: Contents) -> tuple[Floats, Floats]:
    """Return places that a frame goes around: outcomes, or where there are none, the drive or the tiles."""
    if contents.matches.num_rows:
        return lonlat(contents.matches)
    if contents.drives is not None:
        return lonlat(contents.drives)
    return np.zeros(1), np.zeros(1)


def _outcomes(contents: Contents, frame: EnuFrame) -> pd.DataFrame:
    """Join the outcomes with their places and errors."""
    rows: pd.DataFrame = contents.matches.drop_columns([GEOMETRY, BBOX]).to_pandas()
    rows[["x", "y"]] = frame.to_enu(*lonlat(contents.matches))
    fused = contents.fused.set_index("sign_id")
    fused[["map_x", "map_y"]] = _xy(contents.fused, frame)
    names = ["map_x", "map_y", *(name for name in _COVARIANCE if name in fused)]
    rows = rows.join(fused[names], on="fused_id")
    is_tp = rows["outcome"] == "TP"
    rows["east_m"] = (rows["map_x"] - rows["x"]).where(is_tp)
    rows["north_m"] = (rows["map_y"] - rows["y"]).where(is_tp)
    rows["mahalanobis_sq"] = _mahalanobis_sq(rows)
    rows["sign_class"] = rows["ref_class"].fillna(rows["fused_class"])
    rows["sign"] = rows["ref_id"].fillna(rows["fused_id"])
    rows["distance"] = [f"{d:.2f} m" if d == d else "no match" for d in rows["distance_m"].astype(float)]  # noqa: PLR0124 (NaN)
    return rows


_COVARIANCE = ("var_e_m2", "var_n_m2", "cov_en_m2")


def _mahalanobis_sq(rows: pd.DataFrame) -> Any:
    """Return the squared error in units of the map's own covariance, NaN where it has none."""
    if not set(_COVARIANCE) <= set(rows):
        return np.nan
    east, north = rows["east_m"], rows["north_m"]
    var_e, var_n, cov = (rows[name].astype(float) for name in _COVARIANCE)
    determinant = (var_e * var_n - cov**2).where(lambda d: d > 0)
    return (var_n * east**2 - 2 * cov * east * north + var_e * north**2) / determinant


def _evidence(fused: GeoDataFrame) -> list[str]:
    """Say in a line what speaks for each sign of the map, as far as the layer tells."""
    texts = []
    for row in fused.drop(columns="geometry").to_dict("records"):
        known = {name: value for name, value in row.items() if value is not None and value == value}  # noqa: PLR0124 (NaN)
        parts = []
        if "n_passes" in known:
            of = f" of {known['n_opportunities']:.0f}" if "n_opportunities" in known else ""
            parts.append(f"{known['n_passes']:.0f}{of} passes")
        if "n_detections" in known:
            parts.append(f"{known['n_detections']:.0f} detections")
        if "class_confidence" in known:
            parts.append(f"class {known['class_confidence']:.0%}")
        if "existence" in known:
            parts.append(f"exists {known['existence']:.1%}")
        if {"var_e_m2", "var_n_m2"} <= set(known):
            parts.append(f"sigma {known['var_e_m2'] ** 0.5:.2f} m E, {known['var_n_m2'] ** 0.5:.2f} m N")
        texts.append(", ".join(parts) or f"{known.get('source', '')} {known.get('source_ref', '')}".strip())
    return texts


def _worst(outcomes: pd.DataFrame, tiles: tuple[dict[str, Any], ...]) -> pd.DataFrame:
    """Keep the signs of the worst tiles, at most as many as a browser bears."""
    if len(outcomes) <= MOST_SIGNS:
        return outcomes
    sizes = np.cumsum([tile["tp"] + tile["fp"] + tile["fn"] for tile in tiles])
    kept = {tile["tile"] for tile in tiles[: max(1, int(np.searchsorted(sizes, MOST_SIGNS, side="right")))]}
    return outcomes[outcomes["tile"].isin(kept)].reset_index(drop=True)


def _extent(parts: list[Floats]) -> tuple[Floats, Floats]:
    """Return the corners of what is shown, with a margin."""
    every = np.concatenate([part for part in parts if len(part)] or [np.zeros((1, 2))])
    return every.min(axis=0) - _MARGIN_M, every.max(axis=0) + _MARGIN_M


def _xy(frame: GeoDataFrame, enu: EnuFrame) -> Floats:
    return enu.to_enu(frame.geometry.x.to_numpy(), frame.geometry.y.to_numpy())


def _ring(tile: str, frame: EnuFrame) -> Floats:
    west, south, east, north = quadkey_bounds([tile])[0]
    return frame.to_enu([west, east, east, west], [south, south, north, north])


def _split(shapes: NDArray[Any], frame: EnuFrame) -> list[Floats]:
    """Return the points of every line in metres."""
    if not len(shapes):
        return []
    degrees, owner = shapely.get_coordinates(shapes, return_index=True)
    return np.split(frame.to_enu(*degrees.T), np.flatnonzero(np.diff(owner)) + 1)


def _roads(lanes: pa.Table | None, frame: EnuFrame, extent: tuple[Floats, Floats]) -> list[Floats]:
    """Return the roads that come near what is shown, in lines whose points lie a decimetre off at most."""
    if lanes is None:
        return []
    reach = (extent[1] - extent[0]).max()  # panning should not run out of roads at once
    roads = _split(shapely.from_wkb(lanes[GEOMETRY].to_numpy(zero_copy_only=False)), frame)
    low, high = extent[0] - reach, extent[1] + reach
    near = [
        road for road in roads if len(road) > 1 and (road.max(axis=0) > low).all() and (road.min(axis=0) < high).all()
    ]
    return [shapely.get_coordinates(line) for line in shapely.simplify([shapely.LineString(r) for r in near], 0.1)]


def _drives(drives: pa.Table | None, frame: EnuFrame) -> list[Floats]:
    """Return a line a drive and segment, its points a decimetre off at most."""
    if drives is None:
        return []
    xy = frame.to_enu(*lonlat(drives))
    ids = drives["drive_id"].to_numpy(zero_copy_only=False)
    segments = drives["segment"].to_numpy()
    new = np.flatnonzero((ids[1:] != ids[:-1]) | (segments[1:] != segments[:-1])) + 1
    lines = [shapely.LineString(part) for part in np.split(xy, new) if len(part) > 1]
    return [shapely.get_coordinates(line) for line in shapely.simplify(lines, 0.1)] if lines else []
