"""Where two point maps can be compared: the places that both cover."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Flags = NDArray[np.bool_]


def is_within_reach(
    lon_deg: ArrayLike, lat_deg: ArrayLike, *, of_lon_deg: ArrayLike, of_lat_deg: ArrayLike, reach_m: float
) -> Flags:
    """Tell which points lie in the extent of another map: the union of discs of radius `reach_m` around its points.

    A map of a road is long and bent: its bounding box, and its convex hull too, take in whole quarters that it has
    never looked at. Discs follow the road. Of two maps A and B, the points of A within reach of B and those of B within
    reach of A are what lies in the intersection of both extents, since a point always lies in its own map's extent.

    Parameters
    ----------
    lon_deg, lat_deg
        (n,) points to judge.
    of_lon_deg, of_lat_deg
        (m,) points of the other map; with none, nothing is within reach.
    reach_m
        Radius of a disc (inclusive), metres.

    Returns
    -------
    (n,) flags.

    Raises
    ------
    InputError
        The reach is not a positive finite number.
    """
    if not 0 < reach_m < np.inf:
        raise InputError(f"the reach is {reach_m} m", where="clip", todo="Give a positive distance, e.g. 100.")
    here, there = to_ecef(lon_deg, lat_deg), to_ecef(of_lon_deg, of_lat_deg)
    if not len(here) or not len(there):
        return np.zeros(len(here), np.bool_)
    distance_m, _ = cKDTree(there).query(here)
    return np.asarray(distance_m <= reach_m)
