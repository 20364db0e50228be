"""Web Mercator tiles by quadkey, and clusters that do not show them.

Why tiles cannot show. Distances are chords between Earth-centred coordinates: a pair has one distance, whichever tile
looks at it (the chord of 4 m is the distance on the ground to 1e-13 m; the East-North-Up plane of a tile only says
where to look for neighbours). A tile reads a halo of two eps. A core within eps of the tile has all its neighbours in
it and is recognised; a point of the outer half of the halo may fail to be, but is never made a core wrongly. So every
link of a tile's own cores, and every cluster that reaches its own border points, is found by that tile, and no link is
invented. Clusters that are not all the tile's own, or whose border points have a choice, are left *open*: their parts
share cores, by which `join_open` puts them together. The others are closed: no other tile knows of them. The groups are
therefore those of one DBSCAN over all points in the order of their keys, for tiles of any shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.clustering import core_counts, dbscan_groups, split_groups
from geofleet.algorithms.clustering_kernels import join_parts
from geofleet.algorithms.geodesy_kernels import ecef_points, local_axes, tile_planes
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

MAX_ZOOM = 23  # ST_QuadKey's
MAX_LAT_DEG = math.degrees(math.atan(math.sinh(math.pi)))  # 85.0511: where Web Mercator is a square
HALO_PER_EPS = 2.0
_HALF_TURN_DEG = 180.0
_HALO_SLACK = 1.001  # the halo is measured by degrees, to 0.1 %


def halo_m(eps_m: float) -> float:
    """Return the margin that a tile must read around itself, metres."""
    return HALO_PER_EPS * _HALO_SLACK * eps_m


def quadkeys(lon_deg: ArrayLike, lat_deg: ArrayLike, zoom: int) -> list[str]:
    """Return the quadkey of the tile that owns each point, as `ST_QuadKey` does; tiles are half-open.

    Raises
    ------
    InputError
        A position is not finite or outside Web Mercator, or the zoom is not in 1..23.
    """
    lon, lat = np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64)
    if not 1 <= zoom <= MAX_ZOOM:
        raise InputError(f"zoom {zoom} is not in 1..{MAX_ZOOM}.", where="quadkeys")
    n_bad = np.count_nonzero(~((np.abs(lon) <= _HALF_TURN_DEG) & (np.abs(lat) <= MAX_LAT_DEG)))  # NaN is neither
    if n_bad:
        raise InputError(f"{n_bad} of {lon.size} positions are outside Web Mercator.", where="quadkeys")
    side = 1 << zoom
    sine = np.sin(np.radians(lat))
    x = np.floor((lon + 180.0) / 360.0 * side).astype(np.int64) % side  # 180 is -180
    y = np.floor((0.5 - np.log((1.0 + sine) / (1.0 - sine)) / (4.0 * math.pi)) * side)
    y = np.clip(y, 0, side - 1).astype(np.int64)
    shifts = np.arange(zoom - 1, -1, -1)
    digits = ((x[:, None] >> shifts) & 1) + 2 * ((y[:, None] >> shifts) & 1) + ord("0")
    return digits.astype(np.uint8).view(f"S{zoom}").ravel().astype(str).tolist()


def quadkey_bounds(tiles: Sequence[str]) -> Floats:
    """Return west, south, east and north of tiles in degrees, shape (n, 4).

    Raises
    ------
    InputError
        A text is not a quadkey.
    """
    bounds = np.empty((len(tiles), 4))
    for row, tile in enumerate(tiles):
        if not tile or set(tile) - set("0123"):
            raise InputError(f"{tile!r} is not a quadkey.", where="quadkey_bounds")
        side = 1 << len(tile)
        x = int("".join(str(int(digit) & 1) for digit in tile), 2)
        y = int("".join(str(int(digit) >> 1) for digit in tile), 2)
        bounds[row, 0], bounds[row, 2] = x / side * 360 - 180, (x + 1) / side * 360 - 180
        bounds[row, 1], bounds[row, 3] = _lat_deg(y + 1, side), _lat_deg(y, side)
    return bounds


def _lat_deg(y: int, side: int) -> float:
    return math.degrees(math.atan(math.sinh(math.pi * (1 - 2 * y / side))))


@dataclass(frozen=True, slots=True, eq=False)
class TileClusters:
    """Clusters of a batch of tiles, as rows of the points given.

    Parameters
    ----------
    closed_row, closed_cluster
        (n,) the members of the clusters that are final.
    open_row, open_cluster
        (m,) the cores of the open clusters, halo included, and their own border points, one row a reaching cluster.
    open_is_core
        (m,) which of these are cores.
    """

    closed_row: Ints
    closed_cluster: Ints
    open_row: Ints
    open_cluster: Ints
    open_is_core: Flags


def cluster_tiles(
    lon_deg: Floats,
    lat_deg: Floats,
    *,
    tile: Ints,
    tile_centres_deg: Floats,
    is_owned: Flags,
    codes: Ints,
    eps_m: float,
    min_samples: int,
    ecef_m: Floats | None = None,
) -> TileClusters:
    """Cluster points tile by tile, within codes.

    Parameters
    ----------
    lon_deg, lat_deg
        (n,) points, one row a tile that reads them.
    tile
        (n,) which tile reads the row.
    tile_centres_deg
        (n_tiles, 2) longitude and latitude; the tile must lie within 25 km.
    is_owned
        (n,) whether the point lies in the tile, or in its halo of `halo_m(eps_m)`.
    codes
        (n,) integers from 0; no cluster spans two (classes; zeros to ignore them).
    eps_m, min_samples
        As for `clustering.dbscan`. Rows may come in any order: `join_open` settles what depends on it.
    ecef_m
        (n, 3) the points as `ecef_points` gives them, where the caller has them.
    """
    ecef = ecef_points(lon_deg, lat_deg) if ecef_m is None else ecef_m
    groups = tile * (int(codes.max(initial=0)) + 1) + codes
    lon0, lat0 = np.ascontiguousarray(tile_centres_deg[:, 0]), np.ascontiguousarray(tile_centres_deg[:, 1])
    plane = tile_planes(ecef, tile, ecef_points(lon0, lat0), local_axes(lon0, lat0))
    found = dbscan_groups(plane, groups, eps_m=eps_m, min_samples=min_samples, ecef_m=ecef)
    member = found.labels >= 0
    owned, foreign = np.zeros((2, found.n_clusters), np.bool_)
    owned[found.labels[member & is_owned]] = True
    foreign[found.labels[member & ~is_owned]] = True
    foreign[found.contested_label] = True
    owned[found.contested_label] = True
    is_open = np.append(owned & foreign, False)  # noise, label -1, is not open
    is_closed = np.append(owned & ~foreign, False)
    settled = np.ones(len(tile), np.bool_)
    settled[found.contested_point] = False
    row = np.flatnonzero(settled & is_open[found.labels] & (found.is_core | is_owned))
    mine = is_owned[found.contested_point]
    closed = np.flatnonzero(is_closed[found.labels])
    return TileClusters(
        closed_row=closed,
        closed_cluster=found.labels[closed],
        open_row=np.concatenate((row, found.contested_point[mine])),
        open_cluster=np.concatenate((found.labels[row], found.contested_label[mine])),
        open_is_core=np.concatenate((found.is_core[row], np.zeros(np.count_nonzero(mine), np.bool_))),
    )


def join_open(point: Ints, cluster: Ints, is_core: Flags, is_owned: Flags) -> tuple[Ints, Ints]:
    """Put the parts of open clusters together and settle border points that several clusters reach.

    Parameters
    ----------
    point
        (n,) number of the point in the order of the keys over all tiles; a core stands in a row a tile that reads it.
    cluster
        (n,) number of the open cluster, distinct over all tiles.
    is_core, is_owned
        (n,) of the row.

    Returns
    -------
    Rows and their final clusters, each point once. A border point goes to the cluster whose first core comes first.
    """
    if point.size == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    order = np.argsort(point, kind="stable")
    joined, first_core = join_parts(order, point, cluster, is_core)
    whole = joined[cluster]
    row = np.flatnonzero(is_owned)
    row = row[np.lexsort((first_core[whole[row]], point[row]))]
    row = row[np.append(True, np.diff(point[row]) != 0)]
    return row, whole[row]


def split_chains(
    lon_deg: Floats, lat_deg: Floats, cluster: Ints, *, eps_m: float, min_samples: int, share: float
) -> Ints:
    """Cluster the members of each cluster anew with a core rule that follows the densest place around.

    The more passes, the more far-out detections: with a fixed core rule three of them bridge two signs of a class, and
    clusters grow into chains as fleets do. Around a sign detections are dense and between two signs they are not, so a
    cluster is clustered again, by itself, with a core rule relative to the densest place near
    (`clustering.split_groups`); what is left over is noise. It asks for no scale of the errors and no size of the
    fleet. A cluster is known whole by then, so that tiles do not show in this either.

    Parameters
    ----------
    lon_deg, lat_deg
        (n,) members, sorted by cluster, pass and track.
    cluster
        (n,) their clusters.
    eps_m, min_samples
        Those of the clusters.
    share
        Share of the detections within eps_m of the densest place that make a core, 0 … 1.

    Returns
    -------
    (n,) clusters numbered anew, -1 for noise; `cluster` itself where none has a core rule of its own.
    """
    lead = np.flatnonzero(np.append(True, np.diff(cluster) != 0))
    size = np.diff(np.append(lead, cluster.size))
    may_split = core_counts(size, min_samples, share) > min_samples  # no place has more than all
    again = np.repeat(may_split, size)
    if not again.any():
        return cluster
    lead = lead[may_split]
    group = np.repeat(np.arange(lead.size), size[may_split])
    ecef = ecef_points(lon_deg[again], lat_deg[again])
    plane = tile_planes(
        ecef, group, ecef_points(lon_deg[lead], lat_deg[lead]), local_axes(lon_deg[lead], lat_deg[lead])
    )
    found = split_groups(plane, group, eps_m=eps_m, min_samples=min_samples, share=share, ecef_m=ecef)
    split = np.repeat(np.arange(size.size), size)
    split[again] = np.where(found < 0, -1, found + size.size)
    return split
