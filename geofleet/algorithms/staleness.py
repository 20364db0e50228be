"""An outdated copy of a layer of signs: some gone, some read otherwise, some elsewhere, and some that no longer stand.

Which sign meets which fate, and every draw, depends on the key of the sign and the seed: not on the order of the signs.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pyproj import Geod
from scipy.spatial import cKDTree
from scipy.special import ndtri

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Keys = NDArray[np.uint64]

KEPT, REMOVED, RETYPED, MOVED, OBSOLETE = range(5)
FATES = ("kept", "removed", "retyped", "moved", "obsolete")

_GEOD = Geod(ellps="WGS84")
_FATE, _CLASS, _TURN, _EAST, _NORTH, _OBSOLETE, _TRY = range(7)  # what a draw is for; _TRY and on: parts of a try
_NEIGHBOURS = 8
_NEAREST_M, _FARTHEST_M = 10.0, 150.0  # neighbours along a road stand this far apart; nearer ones share a pole
_VERGE_SIGMA_M = 1.0  # of an obsolete sign beside the line from one sign to the next
_CLEARANCE_M = 5.0  # an obsolete sign nearer to a real one of its class would be that sign, moved
_TRIES = 16


@dataclass(frozen=True, slots=True)
class Staleness:
    """How outdated a copy is: shares of the signs, metres.

    Parameters
    ----------
    removed, retyped, moved
        Shares of the signs that are missing, carry another class, or stand `moved_m` away; no sign meets two of them.
    obsolete
        Signs that no longer exist, as a share of the signs.
    moved_m
        How far a moved sign stands from its place, in any direction.
    sigma_m
        Standard deviation of the position of every sign, an axis.
    shift_m
        East and north by which the copy as a whole is off.
    """

    removed: float = 0.0
    retyped: float = 0.0
    moved: float = 0.0
    obsolete: float = 0.0
    moved_m: float = 5.0
    sigma_m: float = 0.0
    shift_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        for name in ("removed", "retyped", "moved", "obsolete"):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} is {getattr(self, name):g}.", todo="Give a share from 0 to 1, e.g. 0.1.")
        if self.removed + self.retyped + self.moved > 1:
            raise InputError("removed, retyped and moved add up to more than 1.", todo="Give smaller shares.")
        for name in ("moved_m", "sigma_m"):
            if not 0 <= getattr(self, name) < np.inf:
                raise InputError(f"{name} is {getattr(self, name):g}.", todo="Give a distance in metres, 0 or more.")
        if not np.isfinite(self.shift_m).all():
            raise InputError(f"shift_m is {self.shift_m}.", todo="Give east and north in metres.")


@dataclass(frozen=True, slots=True)
class StaleSigns:
    """The outdated copy.

    Parameters
    ----------
    fate
        (n,) of every sign given: `KEPT`, `REMOVED`, `RETYPED` or `MOVED`.
    lon_deg, lat_deg
        (n + m,) where the n signs given and then m obsolete ones stand in the copy; of no use for removed signs.
    class_of
        (n + m,) the sign given whose class each has in the copy.
    like
        (m,) the sign given beside which each obsolete one stands.
    key
        (m,) keys of the obsolete signs.
    """

    fate: NDArray[np.int8]
    lon_deg: Floats
    lat_deg: Floats
    class_of: Ints
    like: Ints
    key: Keys


def sign_keys(sign_ids: Sequence[str]) -> Keys:
    """Return a number a sign id, by which draws are made."""
    digests = b"".join(hashlib.blake2b(name.encode(), digest_size=8).digest() for name in sign_ids)
    return np.frombuffer(digests, "<u8").astype(np.uint64)


def make_stale(
    keys: Keys, lon_deg: Floats, lat_deg: Floats, class_code: Ints, how: Staleness, *, seed: int
) -> StaleSigns:
    """Draw an outdated copy of n signs.

    Shares are met exactly, up to rounding: signs are ranked by a draw of their own and the first are removed, the next
    retyped, the next moved. A retyped sign has any other class of the layer, each as likely. An obsolete sign stands
    between two neighbours, as signs along a road do, and has the class of a sign drawn from the layer.

    Parameters
    ----------
    keys
        (n,) from `sign_keys`; no two are alike.
    lon_deg, lat_deg
        (n,) WGS 84.
    class_code
        (n,) classes, from 0.

    Raises
    ------
    InputError
        Signs are to be retyped and there is one class only.
    """
    fate = _fates(keys, how, seed)
    class_of = np.arange(len(keys), dtype=np.int64)
    retyped = np.flatnonzero(fate == RETYPED)
    class_of[retyped] = _other_class(keys, class_code, retyped, seed)
    own_lon, own_lat = _moved(keys, lon_deg, lat_deg, np.where(fate == MOVED, how.moved_m, 0.0), seed)
    key, like, of, lon, lat = _obsolete(
        keys, lon_deg, lat_deg, class_code, n=_count(how.obsolete, len(keys)), seed=seed
    )
    every = np.concatenate((keys, key))
    east = how.shift_m[0] + how.sigma_m * ndtri(_uniform(every, _EAST, seed))
    north = how.shift_m[1] + how.sigma_m * ndtri(_uniform(every, _NORTH, seed))
    lon, lat = offset(np.concatenate((own_lon, lon)), np.concatenate((own_lat, lat)), east, north)
    return StaleSigns(fate, lon, lat, np.concatenate((class_of, of)), like, key)


def offset(lon_deg: Floats, lat_deg: Floats, east_m: Floats, north_m: Floats) -> tuple[Floats, Floats]:
    """Return the places that lie so far east and north of others, along geodesics."""
    azimuth_deg = np.degrees(np.arctan2(east_m, north_m))
    lon, lat, _ = _GEOD.fwd(lon_deg, lat_deg, azimuth_deg, np.hypot(east_m, north_m))
    return np.asarray(lon, np.float64), np.asarray(lat, np.float64)


def distance_m(lon_deg: Floats, lat_deg: Floats, to_lon_deg: Floats, to_lat_deg: Floats) -> Floats:
    """Return the geodesic distance of each place to another."""
    return np.asarray(_GEOD.inv(lon_deg, lat_deg, to_lon_deg, to_lat_deg)[2], np.float64)


def _count(share: float, n: int) -> int:
    return int(np.floor(share * n + 0.5))


def _fates(keys: Keys, how: Staleness, seed: int) -> NDArray[np.int8]:
    fate = np.full(len(keys), KEPT, np.int8)
    order = np.argsort(_uniform(keys, _FATE, seed), kind="stable")
    begin = 0
    for what, share in ((REMOVED, how.removed), (RETYPED, how.retyped), (MOVED, how.moved)):
        end = begin + _count(share, len(keys))
        fate[order[begin:end]] = what
        begin = end
    return fate


def _other_class(keys: Keys, class_code: Ints, retyped: Ints, seed: int) -> Ints:
    """Return, for some signs, a sign of another class: each class is as likely."""
    by_class = np.lexsort((keys, class_code))
    codes, first = np.unique(class_code[by_class], return_index=True)
    if len(retyped) and len(codes) == 1:
        raise InputError("signs are to be retyped, and all are of one class.", todo="Set retyped to 0.")
    own = np.searchsorted(codes, class_code[retyped])
    step = 1 + _pick(_uniform(keys[retyped], _CLASS, seed), len(codes) - 1)
    other: Ints = by_class[first[(own + step) % max(len(codes), 1)]]
    return other


def _moved(keys: Keys, lon_deg: Floats, lat_deg: Floats, by_m: Floats, seed: int) -> tuple[Floats, Floats]:
    turn = 2 * np.pi * _uniform(keys, _TURN, seed)
    return offset(lon_deg, lat_deg, by_m * np.sin(turn), by_m * np.cos(turn))


def _obsolete(
    keys: Keys, lon_deg: Floats, lat_deg: Floats, class_code: Ints, *, n: int, seed: int
) -> tuple[Keys, Ints, Ints, Floats, Floats]:
    """Return key, neighbour, the sign whose class it has, and place of every obsolete sign.

    Of some tries a sign takes the first that is clear of real signs of its class, or else the one farthest from them.
    """
    if n == 0:
        none = np.empty(0, np.int64)
        return np.empty(0, np.uint64), none, none, np.empty(0), np.empty(0)
    order = np.argsort(keys)
    key = _mix(np.arange(n, dtype=np.uint64), _OBSOLETE, seed)
    tries = np.repeat(key, _TRIES) + np.tile(np.arange(_TRIES, dtype=np.uint64), n)
    draws = [_uniform(tries, _TRY + part, seed) for part in range(5)]
    like = order[_pick(draws[0], len(keys))]
    of = order[_pick(draws[1], len(keys))]
    lon, lat = _beside(lon_deg, lat_deg, like, draws[2:])
    clear_m = _clearance(lon, lat, class_code[of], to_ecef(lon_deg, lat_deg), class_code).reshape(n, _TRIES)
    best = np.where(
        (clear_m >= _CLEARANCE_M).any(axis=1), np.argmax(clear_m >= _CLEARANCE_M, axis=1), np.argmax(clear_m, axis=1)
    )
    taken = np.arange(n) * _TRIES + best
    return key, like[taken], of[taken], lon[taken], lat[taken]


def _pick(uniform: Floats, n: int) -> Ints:
    """Return a number below n a draw."""
    return np.minimum(np.floor(uniform * n).astype(np.int64), n - 1)


def _beside(lon_deg: Floats, lat_deg: Floats, like: Ints, draws: Sequence[Floats]) -> tuple[Floats, Floats]:
    """Return a place on the way from each sign to a neighbour, or, where it has none, near it in any direction."""
    end, alone = _neighbour(to_ecef(lon_deg, lat_deg), like, draws[0])
    azimuth_deg, _, length_m = _GEOD.inv(lon_deg[like], lat_deg[like], lon_deg[end], lat_deg[end])
    azimuth_rad = np.where(alone, 2 * np.pi * draws[2], np.radians(azimuth_deg))
    along_m = np.where(alone, _NEAREST_M, np.asarray(length_m)) * (0.2 + 0.6 * draws[1])
    across_m = np.where(alone, 0.0, _VERGE_SIGMA_M * ndtri(draws[2]))
    east = along_m * np.sin(azimuth_rad) + across_m * np.cos(azimuth_rad)
    north = along_m * np.cos(azimuth_rad) - across_m * np.sin(azimuth_rad)
    return offset(lon_deg[like], lat_deg[like], east, north)


def _neighbour(xyz_m: Floats, like: Ints, draw: Floats) -> tuple[Ints, NDArray[np.bool_]]:
    """Draw one of the nearest signs along the road for each sign; tell which have none."""
    away_m, other = cKDTree(xyz_m).query(xyz_m[like], k=min(_NEIGHBOURS + 1, len(xyz_m)))
    away_m, other = np.reshape(away_m, (len(like), -1)), np.reshape(other, (len(like), -1))
    near = (away_m >= _NEAREST_M) & (away_m <= _FARTHEST_M)
    rank, n_near = np.cumsum(near, axis=1), near.sum(axis=1)
    column = np.argmax(rank == 1 + np.floor(draw * n_near).astype(np.int64)[:, None], axis=1)
    return other[np.arange(len(like)), column], n_near == 0


def _clearance(lon_deg: Floats, lat_deg: Floats, code: Ints, ref_xyz: Floats, ref_code: Ints) -> Floats:
    """Return how far each place is from the nearest sign of its class."""
    xyz, clear_m = to_ecef(lon_deg, lat_deg), np.empty(len(code))
    for one in np.unique(code).tolist():
        mine = code == one
        clear_m[mine] = cKDTree(ref_xyz[ref_code == one]).query(xyz[mine])[0]
    return clear_m


def _mix(keys: Keys, purpose: int, seed: int) -> Keys:
    """Return 64 random bits a key: the finaliser of SplitMix64 (doi:10.1145/2714064.2660195) over seed and purpose."""
    state = keys.astype(np.uint64)
    with np.errstate(over="ignore"):
        for word in (np.uint64(seed), np.uint64(purpose)):
            state = (state ^ word) + np.uint64(0x9E3779B97F4A7C15)
            state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            state ^= state >> np.uint64(31)
    return state


def _uniform(keys: Keys, purpose: int, seed: int) -> Floats:
    """Return a draw a key, strictly between 0 and 1."""
    return (np.floor(_mix(keys, purpose, seed) / 2.0**11) + 0.5) / 2.0**53
