"""Scores of a point map against a reference: counts are stored, every score is derived from them by one formula.

Scores are of p = 2 and alpha = 2. GOSPA is Rahmathullah, García-Fernández and Svensson, "Generalized optimal
sub-pattern assignment metric", 2017, doi:10.23919/ICIF.2017.8009645; GOSPA_M is GOSPA per square root of a match, as
the paper that geofleet implements defines it (its section "Evaluation metrics and quality measures"). A score that is
not defined is None and never NaN, and `null_reason` says why; `MapScore` documents each score.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from geofleet.algorithms.matching import Matching, match_points
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Labels = Sequence[Hashable] | NDArray[np.generic]

MatchOn = Literal["class", "concept", "none"]
_ROUNDING = 1e-9  # relative; a sum of squares may exceed its bound by this much


def derive_scores(
    tp: ArrayLike, fp: ArrayLike, fn: ArrayLike, sum_sq_error_m2: ArrayLike, gate_m: ArrayLike
) -> dict[str, Floats]:
    """Derive every score from counts and Σd², for any number of rows at once; `MapScore` documents each score.

    Parameters
    ----------
    tp, fp, fn
        Matched pairs, points of the map without a match, points of the reference without one.
    sum_sq_error_m2
        Σd² over the matched pairs, m².
    gate_m
        c, metres.

    Returns
    -------
    precision, recall, f1, mse_m2, rmse_m, gospa, gospa_m by name, of the common shape; NaN where a score is undefined.
    """
    tp, fp, fn, sum_sq, gate = (np.asarray(v, np.float64) for v in (tp, fp, fn, sum_sq_error_m2, gate_m))
    mse_m2 = _ratio(sum_sq, tp)
    gospa_sq_m2 = sum_sq + gate**2 / 2 * (fn + fp)
    return {
        "precision": _ratio(tp, tp + fp),
        "recall": _ratio(tp, tp + fn),
        "f1": _ratio(2 * tp, 2 * tp + fp + fn),
        "mse_m2": mse_m2,
        "rmse_m": np.sqrt(mse_m2),
        "gospa": np.sqrt(gospa_sq_m2),
        "gospa_m": np.sqrt(_ratio(gospa_sq_m2, tp)),
    }


def null_reason(tp: int, fp: int, fn: int) -> str | None:
    """Say why some scores are undefined for these counts; None when every score is defined."""
    if tp > 0:
        return None
    if fp == fn == 0:
        return "the map and the reference are empty"
    if fp == 0:
        return "the map is empty"
    if fn == 0:
        return "the reference is empty"
    return "no point of the map matches the reference"


def _ratio(numerator: Floats, denominator: Floats) -> Floats:
    """Divide, with NaN where the denominator is 0."""
    numerator, denominator = np.broadcast_arrays(numerator, denominator)
    undefined = np.full(numerator.shape, np.nan)
    np.divide(numerator, denominator, out=undefined, where=denominator != 0)
    return undefined


@dataclass(frozen=True, slots=True)
class MapScore:
    """Counts of a map against a reference, and the scores derived from them.

    Scores of disjoint parts (tiles, classes) add up: `a + b` is the score of both, if gate and `match_on` are the same.

    Parameters
    ----------
    tp, fp, fn
        Matched pairs, points of the map without a match, points of the reference without one.
    sum_sq_error_m2
        Σd² over the matched pairs, m².
    gate_m
        c, the gate of the matching (exclusive) and GOSPA's cut-off, metres.
    match_on
        What a matched pair agrees in: `class`, `concept` or `none`.
    matches
        The pairs themselves, where they are known; a sum of scores has none, and they don't take part in comparisons.

    Raises
    ------
    InputError
        A count is negative, the gate is not a positive finite number, Σd² is not within 0 … tp c², `match_on` is
        unknown, or scores of unlike gate or `match_on` are added.
    """

    tp: int
    fp: int
    fn: int
    sum_sq_error_m2: float
    gate_m: float = 2.0
    match_on: MatchOn = "class"
    matches: Matching | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if min(self.tp, self.fp, self.fn) < 0:
            raise InputError(f"counts tp {self.tp}, fp {self.fp}, fn {self.fn} are negative", where="score")
        if not 0 < self.gate_m < math.inf:
            raise InputError(f"the gate is {self.gate_m} m", where="score", todo="Give a positive distance, e.g. 2.0.")
        if not 0 <= self.sum_sq_error_m2 <= self.tp * self.gate_m**2 * (1 + _ROUNDING):
            raise InputError(
                f"Σd² is {self.sum_sq_error_m2} m², impossible for {self.tp} pairs closer than {self.gate_m} m",
                where="score",
            )
        if self.match_on not in get_args(MatchOn):
            raise InputError(f"match_on is {self.match_on!r}", where="score", todo="Give 'class', 'concept' or 'none'.")

    def __add__(self, other: MapScore) -> MapScore:
        if not isinstance(other, MapScore):
            return NotImplemented
        if (self.gate_m, self.match_on) != (other.gate_m, other.match_on):
            raise InputError(
                f"scores of gate {self.gate_m} m on {self.match_on} and of gate {other.gate_m} m on {other.match_on} "
                "don't add up",
                todo="Score both alike.",
            )
        return MapScore(
            self.tp + other.tp,
            self.fp + other.fp,
            self.fn + other.fn,
            self.sum_sq_error_m2 + other.sum_sq_error_m2,
            self.gate_m,
            self.match_on,
        )

    @property
    def precision(self) -> float | None:
        """TP / (TP + FP): the share of the map that exists.

        Range 0 … 1, perfect 1. None when the map is empty. Paper: equation "Precision".
        """
        return self._derived("precision")

    @property
    def recall(self) -> float | None:
        """TP / (TP + FN): the share of the reference that is in the map.

        Range 0 … 1, perfect 1. None when the reference is empty. Paper: equation "Recall".
        """
        return self._derived("recall")

    @property
    def f1(self) -> float | None:
        """2 TP / (2 TP + FP + FN): the harmonic mean of precision and recall where both are defined and not both 0.

        Range 0 … 1, perfect 1. None only when both maps are empty; 0 when one of them is. Paper: equation "F1".
        """
        return self._derived("f1")

    @property
    def mse_m2(self) -> float | None:
        """MSE_M = Σd² / TP, m²: the mean squared error of the matched points.

        Range 0 … c² (exclusive), perfect 0. None when TP = 0, so also when either map is empty. Paper: "RMSE_M".
        """
        return self._derived("mse_m2")

    @property
    def rmse_m(self) -> float | None:
        """RMSE_M = √MSE_M, metres.

        Range 0 … c (exclusive), perfect 0. None when TP = 0, so also when either map is empty. Paper: "RMSE_M".
        """
        return self._derived("rmse_m")

    @property
    def gospa(self) -> float:
        """GOSPA = √(Σd² + c²/2 (FN + FP)), metres: a metric on sets of points.

        Range 0 … c √((n + m) / 2) for n and m points, perfect 0. Always defined: 0 when both maps are empty. Paper:
        equation "GOSPA4"; doi:10.23919/ICIF.2017.8009645 with p = 2, alpha = 2.
        """
        return float(self._scores()["gospa"])

    @property
    def gospa_m(self) -> float | None:
        """GOSPA_M = GOSPA / √TP = √(localisation + cardinality), metres.

        Range 0 … ∞, perfect 0. None when TP = 0, so also when either map is empty. Not a metric: the triangle
        inequality is GOSPA's. Paper: equation "GOSPA_M".
        """
        return self._derived("gospa_m")

    @property
    def localisation_m2(self) -> float | None:
        """MSE_M, m²: the part of GOSPA_M² that comes from the positions of the matched points.

        Range 0 … c² (exclusive), perfect 0. None when TP = 0, so also when either map is empty. Paper: "GOSPA_M".
        """
        return self.mse_m2

    @property
    def cardinality_m2(self) -> float | None:
        """c²/2 (FN + FP) / TP, m²: the part of GOSPA_M² that comes from missed and false points.

        Range 0 … ∞, perfect 0. None when TP = 0, so also when either map is empty. Paper: "GOSPA_M".
        """
        # GOSPA_M² of the same counts with every error 0
        gospa_m = _finite(derive_scores(self.tp, self.fp, self.fn, 0.0, self.gate_m)["gospa_m"])
        return None if gospa_m is None else gospa_m**2

    @property
    def null_reason(self) -> str | None:
        """Why some scores are None; None when every score is defined, which is when TP > 0."""
        return null_reason(self.tp, self.fp, self.fn)

    def _scores(self) -> dict[str, Floats]:
        return derive_scores(self.tp, self.fp, self.fn, self.sum_sq_error_m2, self.gate_m)

    def _derived(self, name: str) -> float | None:
        return _finite(self._scores()[name])


def _finite(value: Floats) -> float | None:
    return None if np.isnan(value) else float(value)


def score_points(
    xy: ArrayLike,
    classes: Labels | None,
    ref_xy: ArrayLike,
    ref_classes: Labels | None,
    gate_m: float = 2.0,
    *,
    match_on: MatchOn | None = None,
) -> MapScore:
    """Match a point map with a reference and score it.

    Parameters
    ----------
    xy, ref_xy
        (n, 2) and (m, 2), metres in one plane frame, or (n, 3) and (m, 3), Earth-centred; either may be empty.
    classes, ref_classes
        Labels of the points, of any type that can be hashed; only equal ones match. None for both: any pair may match.
    gate_m
        c, metres (exclusive).
    match_on
        What the labels are, `class` or `concept`; by default `class`, and `none` without labels.

    Raises
    ------
    InputError
        Labels are given for one set only, missing, not hashable or not one a point, `match_on` contradicts them, or the
        points or the gate cannot be matched (see `match_points`).
    """
    codes, ref_codes = (None, None) if classes is ref_classes is None else _codes(classes, ref_classes)
    used: MatchOn = match_on or ("none" if codes is None else "class")
    if (used == "none") != (codes is None):
        raise InputError(f"match_on is {used!r}", where="score", todo="Give classes, or match on 'none'.")
    matches = match_points(xy, ref_xy, gate_m=gate_m, codes=codes, ref_codes=ref_codes)
    return MapScore(
        tp=len(matches),
        fp=len(np.asarray(xy)) - len(matches),
        fn=len(np.asarray(ref_xy)) - len(matches),
        sum_sq_error_m2=matches.sum_sq_error_m2,
        gate_m=gate_m,
        match_on=used,
        matches=matches,
    )


def _codes(classes: Labels | None, ref_classes: Labels | None) -> tuple[Ints, Ints]:
    """Return one number a label, equal for equal labels of either set."""
    if classes is None or ref_classes is None:
        raise InputError("only one of the two sets has classes", todo="Give classes for both sets, or for neither.")
    labels, ref_labels = (v.tolist() if isinstance(v, np.ndarray) else list(v) for v in (classes, ref_classes))
    both = [*labels, *ref_labels]
    try:
        code_of = {label: code for code, label in enumerate(dict.fromkeys(both))}
        n_missing = sum(label is None or bool(label != label) for label in both)  # noqa: PLR0124 (NaN is not itself)
    except TypeError as error:
        raise InputError(f"classes cannot be compared: {error}", todo="Give labels such as text or numbers.") from error
    if n_missing:
        raise InputError(f"{n_missing} points have no class", todo="Drop them, or name the unknown class.")
    codes = np.fromiter(map(code_of.__getitem__, both), np.int64, len(both))
    return codes[: len(labels)], codes[len(labels) :]
