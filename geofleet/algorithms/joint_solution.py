"""Places of all signs and the nuisance of all passes at once: sparse normal equations, one of the two eliminated.

Track i of pass v and sign j measures x = (s_j + g_v, b_v): it adds N_i to the blocks of s_j and of (g_v, b_v). A pass
is eliminated with G = (P⁻¹ + Σ N)⁻¹, which leaves a system in the signs alone,

    Λ = Σ_v [blkdiag(N_pp) - B G Bᵀ]      η = Σ_v [r_p - B G r_v]      s = Λ⁻¹ η      x_v = G (r_v - Bᵀ s)

Λ and η are sums over passes: a pass can be added later, or taken out again. Where there are few passes and many signs,
signs are eliminated instead, with their own blocks in the place of G: the same solution from a smaller system.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import linalg, sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint_tracks import Passes, Tracks

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

DENSE_UNKNOWNS = 5000
"""Up to so many unknowns the dense factor is the fastest, and 200 MB."""
DENSE_SHARE = 0.05
"""From this share of all pairs of pass and sign on they are multiplied as dense matrices."""
BLOCK = 512
"""Columns of the inverse that are solved for at a time, and rows of the product."""
LEAST_VAR = 1e-12
"""Variance of what is known exactly: a bias that a sensor cannot have."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Signs and passes that the tracks agree on.

    Parameters
    ----------
    xy_m, cov_m2
        (n_signs, 2), (n_signs, 2, 2): places, with the offset that the fleet has in common in the covariance.
    nuisance, nuisance_cov
        (n_passes, 4), (n_passes, 4, 4): offset east and north, range and bearing bias; covariance given the signs.
    marginal_cov
        (4, 4) covariance of the nuisance of one pass, whatever the signs.
    """

    xy_m: Floats
    cov_m2: Floats
    nuisance: Floats
    nuisance_cov: Floats
    marginal_cov: Floats | None = None


def solve(
    tracks: Tracks,
    passes: Passes,
    sign: Ints,
    n_signs: int,
    nuisance: Floats,
    *,
    with_cov: bool,
    marginal_of: int | None = None,
) -> Solution:
    """Solve for all signs and passes.

    Parameters
    ----------
    tracks, sign
        Tracks, and the sign of each, all ≥ 0.
    nuisance
        (n_passes, 4) where to expand about: a good guess keeps numbers small.
    with_cov
        Whether the covariances of the signs are wanted; else they are zero.
    marginal_of
        The pass whose `marginal_cov` is wanted.
    """
    n_passes = len(passes.gnss_sigma_m)
    prior = 1 / np.maximum(
        np.column_stack((passes.gnss_sigma_m, passes.gnss_sigma_m, passes.bias_sigma)) ** 2, LEAST_VAR
    )
    if n_signs == 0:
        return Solution(
            np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((n_passes, 4)), (1 / prior)[:, :, None] * np.eye(4)
        )
    # expand about the weighted means of the tracks as they lie now: what is solved for is small
    n_pp = tracks.matrix[:, :2, :2]
    measured = tracks.origin_xy_m - nuisance[tracks.pass_code, :2]
    start = _means(measured, n_pp, sign, n_signs)
    shift = np.column_stack((start[sign] - measured, nuisance[tracks.pass_code, 2:]))
    residual = tracks.vector - np.einsum("tij,tj->ti", tracks.matrix, shift)

    own = np.zeros((n_passes, 4, 4))
    np.add.at(own, tracks.pass_code, tracks.matrix)
    own[:, np.arange(4), np.arange(4)] += prior
    right = -prior * nuisance
    np.add.at(right, tracks.pass_code, residual)
    gain = np.asarray(np.linalg.inv(own), np.float64)

    coupling = _blocks(tracks.matrix[:, :, :2], tracks.pass_code, sign, (n_passes, n_signs))
    diagonal, eta = np.zeros((n_signs, 2, 2)), np.zeros((n_signs, 2))
    np.add.at(diagonal, sign, n_pp)
    np.add.at(eta, sign, residual[:, :2])
    equations = _Equations(diagonal, eta, own, right, gain, coupling)
    eliminate = _without_signs if 4 * n_passes < min(2 * n_signs, DENSE_UNKNOWNS) else _without_passes
    step, cov, moved, marginal = eliminate(equations, with_cov=with_cov, marginal_of=marginal_of)
    return Solution(start + step, cov, nuisance + moved, gain, marginal)


class _Equations(NamedTuple):
    """The normal equations, by block: of signs, of passes, and what couples the two."""

    of_sign: Floats  # (n_signs, 2, 2)
    eta: Floats  # (n_signs, 2)
    of_pass: Floats  # (n_passes, 4, 4)
    right: Floats  # (n_passes, 4)
    gain: Floats  # (n_passes, 4, 4) inverse of `of_pass`
    coupling: sparse.csr_array  # (4 n_passes, 2 n_signs)


_Solved = tuple["Floats", "Floats", "Floats", "Floats | None"]  # of signs and their covariances, of passes, marginal


def _without_passes(equations: _Equations, *, with_cov: bool, marginal_of: int | None) -> _Solved:
    """Solve for the signs, then for each pass."""
    diagonal, eta, _, right, gain, coupling = equations
    eliminated = _diagonal(gain) @ coupling
    system = _schur(diagonal, coupling, eliminated, gain)
    wanted = [eta.ravel() - eliminated.T @ right.ravel()]
    if marginal_of is not None:
        wanted += list(eliminated[4 * marginal_of : 4 * marginal_of + 4].toarray())
    solved, cov = _solved(system, np.column_stack(wanted), with_cov=with_cov)
    step = solved[:, 0]
    marginal = None if marginal_of is None else gain[marginal_of] + np.stack(wanted[1:]) @ solved[:, 1:]
    moved = np.einsum("vij,vj->vi", gain, right - (coupling @ step).reshape(right.shape))
    return step.reshape(eta.shape), cov, moved, marginal


def _without_signs(equations: _Equations, *, with_cov: bool, marginal_of: int | None) -> _Solved:
    """Solve for the passes, then for each sign."""
    diagonal, eta, own, right, _, coupling = equations
    inverse = np.asarray(np.linalg.inv(diagonal), np.float64)
    by_sign = sparse.csr_array(coupling.T)
    eliminated = _diagonal(inverse) @ by_sign
    system = _schur(own, by_sign, eliminated, inverse)
    whole = system if isinstance(system, np.ndarray) else system.toarray()
    factor = linalg.cholesky(whole.T, lower=True, overwrite_a=True, check_finite=False)
    moved = linalg.cho_solve((factor, True), right.ravel() - eliminated.T @ eta.ravel(), check_finite=False)
    step = np.einsum("sij,sj->si", inverse, eta) - (eliminated @ moved).reshape(eta.shape)
    cov = np.zeros_like(inverse)
    for begin in range(0, len(cov) if with_cov else 0, BLOCK // 2):
        rows = slice(2 * begin, 2 * begin + BLOCK)
        root = linalg.solve_triangular(factor, eliminated[rows].toarray().T, lower=True, check_finite=False)
        root = root.reshape(len(root), -1, 2)
        cov[begin : begin + BLOCK // 2] = inverse[begin : begin + BLOCK // 2] + np.einsum("vsi,vsj->sij", root, root)
    marginal = None
    if marginal_of is not None:
        mine = np.arange(4 * marginal_of, 4 * marginal_of + 4)
        unit = (np.arange(len(factor))[:, None] == mine).astype(np.float64)
        marginal = linalg.cho_solve((factor, True), unit, check_finite=False)[mine]
    return step, cov, moved.reshape(right.shape), marginal


def _diagonal(blocks: Floats) -> sparse.csr_array:
    """Return the matrix that has these blocks on its diagonal."""
    return sparse.bsr_array((blocks, np.arange(len(blocks)), np.arange(len(blocks) + 1))).tocsr()


def _schur(
    kept: Floats, coupling: sparse.csr_array, eliminated: sparse.csr_array, gain: Floats
) -> sparse.csr_array | Floats:
    """Return what is left of the blocks that are kept, `gain` being the inverse of those that go.

    Dense where it is small and they touch much of it: then the dense product is many times faster.
    """
    n_rows, n = coupling.shape
    own = _diagonal(kept)
    if n > DENSE_UNKNOWNS or coupling.nnz < DENSE_SHARE * n_rows * n:
        system: sparse.csr_array = own - coupling.T @ eliminated
        return system
    halves = _diagonal(np.swapaxes(np.linalg.cholesky(gain), 1, 2)) @ coupling
    whole: Floats = own.toarray()
    for begin in range(0, n_rows, BLOCK):
        half = halves[begin : begin + BLOCK].toarray()
        whole -= half.T @ half
    return whole


def _means(xy_m: Floats, weight: Floats, sign: Ints, n_signs: int) -> Floats:
    total, moment = np.zeros((n_signs, 2, 2)), np.zeros((n_signs, 2))
    np.add.at(total, sign, weight)
    np.add.at(moment, sign, np.einsum("tij,tj->ti", weight, xy_m))
    means: Floats = np.asarray(np.linalg.solve(total, moment[:, :, None])[:, :, 0], np.float64)
    return means


def _blocks(blocks: Floats, row: Ints, column: Ints, shape: tuple[int, int]) -> sparse.csr_array:
    """Return a sparse matrix of blocks; blocks at one place add up."""
    order = np.lexsort((column, row))
    start = np.searchsorted(row[order], np.arange(shape[0] + 1))
    height, width = blocks.shape[1:]
    matrix = sparse.bsr_array(
        (blocks[order], column[order], start), shape=(shape[0] * height, shape[1] * width)
    ).tocsr()
    matrix.sum_duplicates()
    return matrix


def _solved(system: sparse.csr_array | Floats, right: Floats, *, with_cov: bool) -> tuple[Floats, Floats]:
    """Solve the symmetric positive definite system; also the 2 by 2 blocks on the diagonal of its inverse."""
    n = len(right)
    if n <= DENSE_UNKNOWNS:
        whole = system if isinstance(system, np.ndarray) else system.toarray()
        # symmetric: the transpose is the same matrix in the order that is factored in place
        factor = linalg.cho_factor(whole.T, lower=True, overwrite_a=True, check_finite=False)
        step = linalg.cho_solve(factor, right, check_finite=False)
        if not with_cov:
            return step, np.zeros((n // 2, 2, 2))
        inverse = linalg.cho_solve(factor, np.eye(n), check_finite=False)
        at = np.arange(n).reshape(-1, 2)
        return step, inverse[at[:, :, None], at[:, None, :]]
    lu = splu(
        sparse.csc_array(system), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}, diag_pivot_thresh=0.0
    )
    step = lu.solve(right)
    cov = np.zeros((n // 2, 2, 2))
    if not with_cov:
        return step, cov
    # signs that nothing couples share their columns: as many are solved for as the largest part has
    links = sparse.coo_array(system)
    link_of_signs = sparse.csr_array(
        sparse.coo_array((np.ones(links.nnz), (links.coords[0] // 2, links.coords[1] // 2)), shape=(n // 2, n // 2))
    )
    n_parts, part_of = connected_components(link_of_signs, directed=False)
    by_part = np.argsort(part_of, kind="stable")
    rank = np.empty(n // 2, np.int64)
    rank[by_part] = np.arange(n // 2) - np.searchsorted(part_of[by_part], np.arange(n_parts))[part_of[by_part]]
    axis = np.arange(2)
    for begin in range(0, int(rank.max()) + 1, BLOCK // 2):
        signs = np.flatnonzero((rank >= begin) & (rank < begin + BLOCK // 2))
        rows, columns = 2 * signs[:, None] + axis, 2 * (rank[signs, None] - begin) + axis
        unit = np.zeros((n, int(columns.max()) + 1))
        unit[rows, columns] = 1.0
        part = lu.solve(unit)
        cov[signs] = part[rows[:, :, None], columns[:, None, :]]
    return step, cov
