"""Error ellipses of positions, as rings of longitude and latitude."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtri

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_SHORTEST_AXIS_M = 0.01  # GeoJSON is written to a millimetre: a thinner ring could fold over itself


@dataclass(frozen=True, slots=True, eq=False)
class ErrorEllipses:
    """Ellipses that hold the true position with a given probability, if errors are Gaussian.

    Parameters
    ----------
    index
        (k,) rows of the input that have an ellipse: their covariance is given and positive definite.
    ring_deg
        (k, n_points + 1, 2) longitude and latitude, counterclockwise and closed.
    semi_major_m, semi_minor_m
        (k,) half axes, metres.
    orientation_deg
        (k,) direction of the major axis, degrees clockwise from north, 0 <= orientation < 180.
    """

    index: Ints
    ring_deg: Floats
    semi_major_m: Floats
    semi_minor_m: Floats
    orientation_deg: Floats


def error_ellipses(
    lon_deg: ArrayLike,
    lat_deg: ArrayLike,
    *,
    var_e_m2: ArrayLike,
    var_n_m2: ArrayLike,
    cov_en_m2: ArrayLike,
    probability: float = 0.95,
    n_points: int = 48,
) -> ErrorEllipses:
    """Draw the ellipse of every position with a usable covariance.

    The squared Mahalanobis distance of a Gaussian in the plane follows chi² with two degrees of freedom, so the half
    axes are √(q λ) with q its quantile (5.991 for 95 %) and λ the eigenvalues of the covariance. Metres become degrees
    by the curvature of the ellipsoid at the centre, which is right to micrometres within the size of an ellipse.

    Parameters
    ----------
    lon_deg, lat_deg
        (n,) centres.
    var_e_m2, var_n_m2, cov_en_m2
        (n,) covariance of the position, east and north; NaN where it is not known.
    probability
        That the ellipse holds the true position, in (0, 1).
    n_points
        Corners of a ring.

    Raises
    ------
    InputError
        The probability is not in (0, 1).
    """
    if not 0 < probability < 1:
        raise InputError(f"the probability is {probability}", where="ellipses", todo="Give one in (0, 1), e.g. 0.95.")
    lon, lat, var_e, var_n, cov = (np.asarray(v, np.float64) for v in (lon_deg, lat_deg, var_e_m2, var_n_m2, cov_en_m2))
    half_sum, half_difference = (var_e + var_n) / 2, np.hypot((var_e - var_n) / 2, cov)
    scale = float(chdtri(2, 1 - probability))
    least = half_sum - half_difference
    usable = (scale * least >= _SHORTEST_AXIS_M**2) & np.isfinite(half_sum + half_difference)  # NaN is neither
    index = np.flatnonzero(usable)
    major = np.sqrt(scale * (half_sum + half_difference)[index])
    minor = np.sqrt(scale * least[index])
    # of the major axis, from east to the left
    angle = np.arctan2(2 * cov[index], (var_e - var_n)[index]) / 2
    turn = np.linspace(0.0, 2 * math.pi, n_points + 1)
    along, across = major[:, None] * np.cos(turn), minor[:, None] * np.sin(turn)
    east = along * np.cos(angle)[:, None] - across * np.sin(angle)[:, None]
    north = along * np.sin(angle)[:, None] + across * np.cos(angle)[:, None]
    per_lon, per_lat = _metres_per_degree(lon[index], lat[index])
    ring = np.stack((lon[index, None] + east / per_lon[:, None], lat[index, None] + north / per_lat[:, None]), axis=-1)
    ring[:, -1] = ring[:, 0]  # closed to the bit
    return ErrorEllipses(index, ring, major, minor, (90.0 - np.degrees(angle)) % 180.0)


def _metres_per_degree(lon_deg: Floats, lat_deg: Floats) -> tuple[Floats, Floats]:
    """Return the length of a degree of longitude and of latitude at each point, from chords of 2 m."""
    step = 1e-5
    per_lon = to_ecef(lon_deg + step, lat_deg) - to_ecef(lon_deg - step, lat_deg)
    per_lat = to_ecef(lon_deg, lat_deg + step) - to_ecef(lon_deg, lat_deg - step)
    return np.linalg.norm(per_lon, axis=1) / (2 * step), np.linalg.norm(per_lat, axis=1) / (2 * step)
