"""Whether joint fusion is as good as it says, and as it could be: errors, existence, and the bound."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from joint_maps import accepted, own_sign, without_translation

from geofleet.algorithms.joint_search import believed
from geofleet.engines.joint import SUSPECT_NOISE

if TYPE_CHECKING:
    from joint_fleets import Run
    from joint_maps import Known
    from numpy.typing import NDArray

    from geofleet.algorithms.joint import JointMap

    Floats = NDArray[np.float64]

CHI2_90 = 4.605  # 2 degrees of freedom
EDGES = np.array([0.0, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0])


def errors(run: Run, fused: JointMap) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Return error of each true sign of the map, its square in units of the covariance, and which sign it is."""
    own = own_sign(run, fused)
    rows = np.flatnonzero(accepted(fused) & (own >= 0))
    error = fused.xy_m[rows] - run.reference_xy[run.reported[own[rows]]]
    return error, np.einsum("ni,nij,nj->n", error, np.linalg.inv(fused.cov_m2[rows]), error), own[rows]


def covered(run: Run, fused: JointMap) -> float:
    """Return the share of signs within their 90 % ellipse."""
    chi2 = errors(run, fused)[1]
    return float((chi2 <= CHI2_90).mean()) if len(chi2) else float("nan")


def faults(run: Run, fused: JointMap) -> NDArray[np.int64]:
    """Return how many passes are faulty, and named as such; how many are sound, and named: (4,)."""
    declared, faulty = run.fleet.passes, np.array(run.passes["sensor_kind"].to_pylist()) == "faulty"
    # by what `geofleet aggregate` names them by: offset or biases that it does not believe, or noise
    found = believed(declared, fused.nuisance, len(faulty))
    named = (found.gnss_sigma_m > declared.gnss_sigma_m) | (found.bias_sigma > declared.bias_sigma).any(axis=1)
    named |= fused.noise_factor[: len(faulty)] > SUSPECT_NOISE
    return np.array([faulty.sum(), (faulty & named).sum(), (~faulty).sum(), (~faulty & named).sum()])


@dataclass
class Honesty:
    """What many runs at one fleet size tell."""

    relative_m2: list[float] = field(default_factory=list)
    known_m2: list[float] = field(default_factory=list)
    bound_m2: list[float] = field(default_factory=list)
    chi2: list[Floats] = field(default_factory=list)
    stated: list[Floats] = field(default_factory=list)
    is_sign: list[NDArray[np.bool_]] = field(default_factory=list)

    def add(self, run: Run, fused: JointMap, best: Known) -> None:
        """Add a run: the relative geometry is compared over the signs that the map has."""
        error, chi2, own = errors(run, fused)
        self.stated.append(fused.existence)
        self.is_sign.append(own_sign(run, fused) >= 0)
        self.chi2.append(chi2)
        if len(own) < 2:  # noqa: PLR2004 - one place has no relative geometry
            return
        at = np.column_stack((2 * own, 2 * own + 1)).ravel()
        of_best = (best.xy_m - run.reference_xy[run.reported])[own]
        self.relative_m2.append(_mean_square(error))
        self.known_m2.append(_mean_square(of_best))
        self.bound_m2.append(float(np.trace(without_translation(best.cov_m2[np.ix_(at, at)])) / len(own)))

    def summary(self) -> dict[str, Any]:
        """Return the figures that are told."""
        chi2, p, y = np.concatenate(self.chi2), np.concatenate(self.stated), np.concatenate(self.is_sign)
        return {
            "n": len(self.chi2),
            "relative_rmse_m": _root_mean(self.relative_m2),
            "known_rmse_m": _root_mean(self.known_m2),
            "bound_m": _root_mean(self.bound_m2),
            "relative_median_m": float(np.sqrt(np.median(self.relative_m2))),
            "bound_median_m": float(np.sqrt(np.median(self.bound_m2))),
            "nees_mean": float(chi2.mean()),
            "nees_median": float(np.median(chi2)),
            "coverage_90": float((chi2 <= CHI2_90).mean()),
            "brier": float(((p - y) ** 2).mean()),
            "brier_of_base_rate": float(y.mean() * (1 - y.mean())),
            "reliability": _reliability(p, y),
        }


def _mean_square(error: Floats) -> float:
    relative = error - error.mean(axis=0)
    return float((relative**2).sum() / len(relative))


def _root_mean(squares: list[float]) -> float:
    return float(np.sqrt(np.mean(squares)))


def _reliability(p: Floats, y: NDArray[np.bool_]) -> list[dict[str, float]]:
    of = np.clip(np.searchsorted(EDGES, p, side="right") - 1, 0, len(EDGES) - 2)
    return [
        {"n": int((of == b).sum()), "stated": float(p[of == b].mean()), "true": float(y[of == b].mean())}
        for b in range(len(EDGES) - 1)
        if (of == b).any()
    ]
