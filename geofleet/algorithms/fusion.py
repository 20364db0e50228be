"""From the members of a cluster to a sign: position, covariance, class, counts and id.

Members come sorted by cluster and key, and everything is summed in that order, in a frame at the first member: the same
members give the same bits, whoever holds them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from pyproj import Transformer

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.geodesy_kernels import ecef_points, local_axes

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

COMMON_SIGMA_M = 1.0
POSITION_DIGITS = 9  # degrees: 0.1 mm
_HASH_DIGITS = 12
_SUFFIX_LETTERS = 8
ID_SHIFT = np.uint64(64 - 4 * _HASH_DIGITS)  # what an id leaves of a hash


@dataclass(frozen=True, slots=True, eq=False)
class FusedSigns:
    """One row a cluster.

    Parameters
    ----------
    lon_deg, lat_deg
        (n,) weighted centroid, rounded to 1e-9 degrees.
    var_e_m2, var_n_m2, cov_en_m2
        (n,) covariance of the centroid, m²; NaN when a single pass leaves nothing to tell it from.
    n_passes, n_detections
        (n,) distinct passes and members.
    """

    lon_deg: Floats
    lat_deg: Floats
    var_e_m2: Floats
    var_n_m2: Floats
    cov_en_m2: Floats
    n_passes: Ints
    n_detections: Ints


def information_weights(var_m2: Floats) -> Floats:
    """Return what each detection knows about the position of its sign, 1/m².

    A detection is wrong by σ² = τ² + v, v being the variance of its mean over frames (s²/F for F frames of spread s).
    The part τ is common to the frames of a pass (GNSS offset, range and bearing calibration), so no number of frames
    removes it; detections do not declare it, and COMMON_SIGMA_M (1 m, the order of a car's GNSS) stands for it. It
    keeps a long or a smooth track from outvoting whole passes.

    Parameters
    ----------
    var_m2
        (n,) variance of the position of each detection, mean of east and north, m².
    """
    return 1.0 / (COMMON_SIGMA_M**2 + var_m2)


def fuse(
    lon_deg: Floats, lat_deg: Floats, *, weight: Floats, pass_code: Ints, first: Ints, ecef_m: Floats | None = None
) -> FusedSigns:
    """Estimate the position of every cluster and its covariance.

    The centroid is the weighted mean in the plane that touches the ellipsoid at the first member. Its covariance
    comes from the scatter *between* passes, as errors within a pass are common: with the share h_p of pass p in the
    weight and the residual r_p of its mean, S = Σ h_p r_p r_pᵀ / (1 - Σ h_p²) estimates the covariance of one pass
    without bias and S Σ h_p² that of the centroid; equal shares give the textbook S / P. What all passes share is not
    in it.

    Parameters
    ----------
    lon_deg, lat_deg, weight, pass_code
        (n,) members, sorted by cluster, pass and track.
    first
        (n_clusters + 1,) `first[k]:first[k + 1]` are the members of cluster k; none is empty.
    ecef_m
        (n, 3) the members as `ecef_points` gives them, where the caller has them.
    """
    lead = first[:-1]
    xyz = ecef_points(lon_deg, lat_deg) if ecef_m is None else ecef_m
    origin, axes = xyz[lead], local_axes(lon_deg[lead], lat_deg[lead])
    centre, covariance, n_passes = _sum_members(xyz, origin, axes, weight, pass_code, first)
    lon, lat = _on_ground(origin, axes, centre)
    return FusedSigns(
        lon_deg=np.round(lon, POSITION_DIGITS),
        lat_deg=np.round(lat, POSITION_DIGITS),
        var_e_m2=covariance[:, 0],
        var_n_m2=covariance[:, 1],
        cov_en_m2=covariance[:, 2],
        n_passes=n_passes,
        n_detections=np.diff(first),
    )


def move_to_members(fused: FusedSigns, lon_deg: Floats, lat_deg: Floats) -> FusedSigns:
    """Return the signs at one of their members each, the medoid.

    For Gaussian scatter of n detections with variance σ² an axis the spatial median varies by 4/π σ²/n (Brown 1983,
    doi:10.1111/j.2517-6161.1983.tb01226.x), and the member nearest to it lies σ²/n an axis away from it: the
    covariance is that of the plain mean times 1 + 4/π.

    Parameters
    ----------
    fused
        Plain means.
    lon_deg, lat_deg
        (n,) the member of each.
    """
    scale = 1 + 4 / np.pi
    return replace(
        fused,
        lon_deg=np.round(lon_deg, POSITION_DIGITS),
        lat_deg=np.round(lat_deg, POSITION_DIGITS),
        var_e_m2=fused.var_e_m2 * scale,
        var_n_m2=fused.var_n_m2 * scale,
        cov_en_m2=fused.cov_en_m2 * scale,
    )


@kernel
def _sum_members(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    xyz: Floats, origin: Floats, axes: Floats, weight: Floats, pass_code: Ints, first: Ints
) -> tuple[Floats, Floats, Ints]:
    """Return centroids (n, 2), covariances (n, 3: ee, nn, en) and the number of passes of every cluster."""
    n = first.size - 1
    centre, covariance, n_passes = np.zeros((n, 2)), np.full((n, 3), np.nan), np.zeros(n, np.int64)
    sums = np.empty((np.diff(first).max() if n else 0, 3))  # weight, weighted east and north of every pass
    for k in range(n):
        p = -1
        for i in range(first[k], first[k + 1]):
            if i == first[k] or pass_code[i] != pass_code[i - 1]:
                p += 1
                sums[p] = 0.0
            sums[p, 0] += weight[i]
            for axis in range(2):
                along = 0.0
                for side in range(3):
                    along += (xyz[i, side] - origin[k, side]) * axes[k, axis, side]
                sums[p, axis + 1] += weight[i] * along
        passes = sums[: p + 1]
        n_passes[k] = p + 1
        total = passes[:, 0].sum()
        centre[k, 0], centre[k, 1] = passes[:, 1].sum() / total, passes[:, 2].sum() / total
        if p:
            covariance[k] = _scatter(passes, total, centre[k])
    return centre, covariance, n_passes


@kernel
def _scatter(passes: Floats, total: float, centre: Floats) -> Floats:
    """Return the covariance (ee, nn, en) of a centroid from the scatter of its passes."""
    sum_sq_share = 0.0
    scatter = np.zeros(3)
    for p in range(passes.shape[0]):
        share = passes[p, 0] / total
        east, north = passes[p, 1] / passes[p, 0] - centre[0], passes[p, 2] / passes[p, 0] - centre[1]
        sum_sq_share += share * share
        scatter[0] += share * east * east
        scatter[1] += share * north * north
        scatter[2] += share * east * north
    return scatter * (sum_sq_share / (1.0 - sum_sq_share))


@cache
def _from_ecef() -> Transformer:
    return Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )


def _on_ground(origin: Floats, axes: Floats, centre: Floats) -> tuple[Floats, Floats]:
    """Return longitude and latitude of points in tangent planes; the height over the plane is solved for."""
    local = np.column_stack((centre, np.zeros(len(centre))))
    lon = lat = np.empty(0)
    for _ in range(3):
        lon, lat, height = _from_ecef().transform(*(origin + np.einsum("kj,kjc->kc", local, axes)).T)
        local[:, 2] -= height
    return lon, lat


def vote(class_code: Ints, confidence: Floats, first: Ints) -> tuple[Ints, Floats]:
    """Return the class of every cluster and its confidence.

    Every detection has one vote, however many frames it has: what a pass mistakes once it mistakes in every frame. Ties
    go to the class that comes first. The confidence is the sum of the winners' confidences (1 where missing) over the
    number of votes.
    """
    n_classes = int(class_code.max(initial=0)) + 1
    return _count_votes(class_code, confidence, first, n_classes)


@kernel
def _count_votes(class_code: Ints, confidence: Floats, first: Ints, n_classes: int) -> tuple[Ints, Floats]:
    n = first.size - 1
    winner, share = np.empty(n, np.int64), np.empty(n)
    votes, trust = np.zeros(n_classes, np.int64), np.zeros(n_classes)
    for k in range(n):
        best = class_code[first[k]]
        for i in range(first[k], first[k + 1]):
            votes[class_code[i]] += 1
            trust[class_code[i]] += confidence[i] if np.isfinite(confidence[i]) else 1.0
        for i in range(first[k], first[k + 1]):
            code = class_code[i]
            if votes[code] > votes[best] or (votes[code] == votes[best] and code < best):
                best = code
        winner[k], share[k] = best, trust[best] / (first[k + 1] - first[k])
        for i in range(first[k], first[k + 1]):
            votes[class_code[i]], trust[class_code[i]] = 0, 0.0
    return winner, share


def name_hashes(hashes: NDArray[np.uint64]) -> NDArray[np.bytes_]:
    """Return an id for every hash: "f" and the first 12 hexadecimal digits, as fixed-width bytes.

    Ids that collide (2⁻⁴⁸ a pair) are told apart by a suffix, in the order given.

    Parameters
    ----------
    hashes
        (n,) in the order of their first 48 bits.
    """
    number = hashes.astype(np.uint64) >> ID_SHIFT
    digits = np.frombuffer(b"0123456789abcdef", np.uint8)
    letters = np.empty((number.size, 1 + _HASH_DIGITS), np.uint8)
    letters[:, 0] = ord("f")
    for digit in range(_HASH_DIGITS):  # one at a time: all at once would hold a hundred bytes an id
        letters[:, 1 + digit] = digits[(number >> np.uint64(4 * (_HASH_DIGITS - 1 - digit))) & np.uint64(15)]
    names = letters.reshape(-1).view(f"S{1 + _HASH_DIGITS}")
    repeated = np.flatnonzero(np.diff(number, prepend=number[:1] ^ np.uint64(1)) == 0)
    if repeated.size:
        names = names.astype(f"S{1 + _HASH_DIGITS + _SUFFIX_LETTERS}")
        for row in repeated.tolist():
            names[row] += b"-%d" % (row - int(np.searchsorted(number, number[row])) + 1)
    return names


@kernel
def hash_members(pass_hash: NDArray[np.uint64], track_id: Ints, first: Ints) -> NDArray[np.uint64]:
    """Return a hash of every cluster's members in their order, which names it.

    The keys are chained through the finaliser of SplitMix64 (doi:10.1145/2714064.2660195).
    """
    hashes = np.empty(first.size - 1, np.uint64)
    for k in range(first.size - 1):
        state = np.uint64(0x9E3779B97F4A7C15)
        for i in range(first[k], first[k + 1]):
            for word in (pass_hash[i], np.uint64(track_id[i])):
                state = (state ^ word) + np.uint64(0x9E3779B97F4A7C15)
                state = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
                state = (state ^ (state >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
                state ^= state >> np.uint64(31)
        hashes[k] = state
    return hashes
