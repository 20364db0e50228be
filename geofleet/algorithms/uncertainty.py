"""How far a score can be trusted: intervals over independent runs, and the words that every interval carries.

An interval says in words what it is an interval for (`Interval.estimand`), because a score has more than one: the mean
over runs of a procedure, or what the procedure would score on a longer road (`geofleet.algorithms.uncertainty_road`).
What an interval cannot promise stands in `Interval.note`. `docs/uncertainty.md` has the coverage measured for each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from scipy import special

from geofleet.algorithms.uncertainty_mean import bca_ends, bootstrap_t_ends, mean_of, standard_error, t_ends
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Method = Literal["t", "bca", "bootstrap_t", "median"]
Direction = Literal["higher", "lower"]

BETTER: dict[str, Direction] = {
    "precision": "higher",
    "recall": "higher",
    "f1": "higher",
    "mse_m2": "lower",
    "rmse_m": "lower",
    "gospa": "lower",
    "gospa_m": "lower",
}
"""Which way each score of `MapScore` is better."""

MIN_RUNS = 3
FEW_RUNS = 8
MANY_RUNS = 30
MIN_DRAWS = 99
_SKEWED = 0.7  # of the sample's skewness


@dataclass(frozen=True, slots=True)
class Interval:
    """A confidence interval, or the reason why there is none.

    Parameters
    ----------
    low, high
        The ends, in the unit of the score; both None where no interval can be given, and `note` says why.
    level
        The share of repetitions whose interval should hold the estimand, e.g. 0.95.
    estimand
        What the interval is for, in words.
    method
        How it was made, in words.
    note
        When not to trust it; empty when nothing is to be said.
    estimate
        The score itself; None when it is undefined.
    n_null
        Runs without a score; they are left out, and `estimand` and `note` say so.
    """

    low: float | None
    high: float | None
    level: float
    estimand: str
    method: str
    note: str = ""
    estimate: float | None = None
    n_null: int = 0


@dataclass(frozen=True, slots=True)
class Comparison:
    """Map or procedure A against B.

    Parameters
    ----------
    interval
        Of score(A) - score(B); `interval.estimate` is the difference seen.
    p_value
        Two-sided, of the hypothesis that the difference is 0; below 1 - level exactly when the interval excludes 0.
        None where there is no interval.
    better
        Whether a `higher` or a `lower` score is better.
    """

    interval: Interval
    p_value: float | None
    better: Direction

    @property
    def verdict(self) -> Literal["A is better", "B is better", "no difference shown"]:
        """What the comparison shows at the level of its interval."""
        low, high = self.interval.low, self.interval.high
        if low is None or high is None or low <= 0 <= high:
            return "no difference shown"
        return "A is better" if (low > 0) == (self.better == "higher") else "B is better"


def replicate_interval(
    scores: Sequence[float | None] | Floats,
    *,
    score: str = "score",
    method: Method = "t",
    level: float = 0.95,
    n_draws: int = 9999,
    seed: int = 0,
) -> Interval:
    """Give the interval of a procedure's expected (or median) score from independent runs of it.

    Parameters
    ----------
    scores
        (n,) one a run; None or NaN where a run has no score. Their order plays no part.
    score
        Name of the score, for the words of the result.
    method
        `t`: Student's interval of the mean. `bca`: bias-corrected and accelerated bootstrap of the mean
        (doi:10.1080/01621459.1987.10478410), its tails widened to those of t for few runs
        (doi:10.1080/00031305.2015.1089789). `bootstrap_t`: studentised bootstrap of the mean
        (doi:10.1007/978-1-4899-4541-9), the best of the three for skewed scores, at the price of width. `median`: order
        statistics, of the median, free of any distribution.
        A percentile bootstrap is not on offer: of five to ten runs it covers 80 to 90 % instead of 95.
    n_draws, seed
        Of the bootstrap; equal arguments give equal intervals.

    Raises
    ------
    InputError
        A score is infinite or not a number, or an option is out of range.
    """
    check_level(level)
    if method not in get_args(Method):
        raise InputError(f"method is {method!r}", where="interval", todo="Give 't', 'bca', 'bootstrap_t' or 'median'.")
    if n_draws < MIN_DRAWS:
        raise InputError(
            f"{n_draws} bootstrap draws", where="interval", todo=f"Give at least {MIN_DRAWS}, better 9999."
        )
    values = _scores(scores)
    defined = np.sort(values[~np.isnan(values)])
    n_null = values.size - defined.size
    words = _over_runs(method, score, defined.size, n_null)
    estimate = None if not defined.size else float(np.median(defined) if method == "median" else mean_of(defined))
    if defined.size < MIN_RUNS:
        note = joined(f"{defined.size} runs with a score are too few for an interval", words.note)
        return Interval(None, None, level, words.estimand, words.method, note, estimate, n_null)
    if method == "median":
        return _median_interval(defined, level=level, words=words, n_null=n_null)
    if method == "t":
        ends = t_ends(defined, level)
    else:
        by_bootstrap = bca_ends if method == "bca" else bootstrap_t_ends
        ends = by_bootstrap(defined, level, n_draws=n_draws, seed=seed)
    if not np.isfinite(ends).all():
        note = joined(f"{defined.size} runs are too few: some draws of them have no spread", words.note)
        return Interval(None, None, level, words.estimand, words.method, note, estimate, n_null)
    note = joined(_few(defined.size), _shape(defined, method), words.note)
    return Interval(*ends, level, words.estimand, words.method, note, estimate, n_null)


def compare_replicates(
    scores_a: Sequence[float | None] | Floats,
    scores_b: Sequence[float | None] | Floats,
    *,
    score: str,
    level: float = 0.95,
) -> Comparison:
    """Test whether procedure A scores better than B, from runs paired by replicate: Student's paired t test.

    Parameters
    ----------
    scores_a, scores_b
        (n,) each; runs at one place share their replicate (world, passes, random numbers). A pair in which either
        score is None or NaN is left out and counted.
    score
        A name of `BETTER`, which says which way it is better.

    Raises
    ------
    InputError
        The two have unlike numbers of runs, a score is infinite, the score's name is unknown or the level out of range.
    """
    check_level(level)
    better = direction(score)
    a, b = _scores(scores_a), _scores(scores_b)
    if a.size != b.size:
        raise InputError(f"{a.size} runs of A and {b.size} of B", where="comparison", todo="Pair them by replicate.")
    difference = a - b
    defined = np.sort(difference[~np.isnan(difference)])
    n_null = difference.size - defined.size
    words = _over_runs("t", f"difference in {score} (A - B)", defined.size, n_null, unit="pair")
    estimate = mean_of(defined) if defined.size else None
    if defined.size < MIN_RUNS:
        note = joined(f"{defined.size} pairs with both scores are too few for a test", words.note)
        return Comparison(
            Interval(None, None, level, words.estimand, words.method, note, estimate, n_null), None, better
        )
    low, high = t_ends(defined, level)
    note = joined(_few(defined.size), _shape(defined, "t"), words.note)
    interval = Interval(low, high, level, words.estimand, words.method, note, estimate, n_null)
    return Comparison(interval, two_sided_p(mean_of(defined), standard_error(defined), defined.size - 1), better)


def two_sided_p(difference: float, standard_error: float, dof: float) -> float:
    """Return the p-value of a difference under Student's t; 1 where there is neither a difference nor a spread."""
    if standard_error == 0:
        return 1.0 if difference == 0 else 0.0
    return float(2 * special.stdtr(dof, -abs(difference) / standard_error))


def direction(score: str) -> Direction:
    """Return which way a score is better.

    Raises
    ------
    InputError
        No score has this name.
    """
    try:
        return BETTER[score]
    except KeyError:
        raise InputError(f"there is no score {score!r}", todo=f"Give one of {', '.join(BETTER)}.") from None


def check_level(level: float, where: str = "interval") -> None:
    """Raise InputError, which names where the level was given, unless it is a share between 0 and 1."""
    if not 0 < level < 1:
        raise InputError(f"the level is {level}.", where=where, todo="Give a share between 0 and 1, e.g. 0.95.")


def _scores(scores: Sequence[float | None] | Floats) -> Floats:
    """Return scores as floats with NaN for none."""
    try:
        values = np.asarray([math.nan if s is None else s for s in scores], np.float64)
    except (TypeError, ValueError) as error:
        raise InputError("scores are not numbers", where="interval", todo="Give one number a run, or None.") from error
    if values.ndim != 1:
        raise InputError(f"scores have shape {values.shape}", where="interval", todo="Give one number a run.")
    if np.isinf(values).any():
        raise InputError("a score is infinite", where="interval", todo="Give None where a score is undefined.")
    return values


@dataclass(frozen=True, slots=True)
class _Words:
    estimand: str
    method: str
    note: str


def _over_runs(method: Method, score: str, n: int, n_null: int, *, unit: str = "run") -> _Words:
    """Say what an interval over runs is for, how it is made, and what the missing scores do to it."""
    what = "median" if method == "median" else "expected"
    among = f", among {unit}s in which it is defined" if n_null else ""
    how = {
        "t": f"Student's t over {n} {unit}s",
        "bca": f"BCa bootstrap over {n} {unit}s, tails widened to Student's t",
        "bootstrap_t": f"bootstrap-t over {n} {unit}s",
        "median": f"order statistics of {n} {unit}s",
    }
    missing = f"{n_null} of {n + n_null} {unit}s have no score and are left out" if n_null else ""
    return _Words(f"the {what} {score} of a {unit} of this procedure{among}", how[method], missing)


def _median_interval(values: Floats, *, level: float, words: _Words, n_null: int) -> Interval:
    """Return the narrowest symmetric pair of order statistics that holds the median with at least `level`."""
    n, estimate = values.size, float(np.median(values))
    k = median_rank(n, level)
    if k < 1:
        note = joined(f"{n} runs are too few: even their whole range falls short of {level:.0%}", words.note)
        return Interval(None, None, level, words.estimand, words.method, note, estimate, n_null)
    exact = 1 - 2 * float(special.bdtr(k - 1, n, 0.5))
    note = joined(f"covers {exact:.1%} exactly, the least of {level:.0%} or more that {n} runs can give", words.note)
    ends = float(values[k - 1]), float(values[n - k])
    return Interval(*ends, level, words.estimand, words.method, note, estimate, n_null)


def median_rank(n: int, level: float) -> int:
    """Return the largest k for which the k-th smallest and the k-th largest of n hold the median with a probability.

    Both lie on one side of it with probability P(Binomial(n, 1/2) < k); 0 when n are too few for any pair.
    """
    return int(np.searchsorted(special.bdtr(np.arange(n + 1), n, 0.5), (1 - level) / 2))


def _few(n: int) -> str:
    """Say what a small number of runs does to an interval of their mean."""
    if n >= MANY_RUNS:
        return ""
    rare = f"a bad run rarer than one in {n} may not have shown, and is then in no interval of a mean"
    return f"{n} runs are few: coverage is approximate; {rare}" if n < FEW_RUNS else rare


def _shape(values: Floats, method: Method) -> str:
    """Say what the distribution of the scores does to an interval of their mean."""
    if np.ptp(values) == 0:
        return f"all {values.size} scores are equal, which says nothing about their spread"
    skewness = _skewness(values)
    if abs(skewness) <= _SKEWED:
        return ""
    name = {"t": "Student's t", "bca": "BCa", "bootstrap_t": "bootstrap-t"}[method]
    return (
        f"the scores are skewed ({skewness:+.1f}): {name} may cover as little as 80 % with ten runs; "
        "the median is safer"
    )


def _skewness(values: Floats) -> float:
    """Return the skewness of the distribution that values come from (G1); of two values, 0."""
    n, off = values.size, values - values.mean()
    biased = float(np.mean(off**3) / np.mean(off**2) ** 1.5)
    return biased * math.sqrt(n * (n - 1)) / (n - 2) if n > 2 else biased  # noqa: PLR2004 (G1 needs three)


def joined(*notes: str) -> str:
    """Join the notes that say something."""
    return "; ".join(note for note in notes if note)
