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
from scipy import stats

from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Method = Literal["t", "bca", "median"]
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
_SKEWED = 1.0  # of the sample's skewness; beyond it the t interval of ten runs covers about 90 %


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
        (doi:10.1080/00031305.2015.1089789). `median`: order statistics, of the median, free of any distribution.
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
        raise InputError(f"method is {method!r}", where="interval", todo="Give 't', 'bca' or 'median'.")
    if n_draws < 1:
        raise InputError(f"{n_draws} bootstrap draws", where="interval", todo="Give at least 1, better 9999.")
    values = _scores(scores)
    defined = np.sort(values[~np.isnan(values)])
    n_null = values.size - defined.size
    words = _over_runs(method, score, defined.size, n_null)
    estimate = None if not defined.size else float(np.median(defined) if method == "median" else _mean(defined))
    if defined.size < MIN_RUNS:
        note = joined(f"{defined.size} runs with a score are too few for an interval", words.note)
        return Interval(None, None, level, words.estimand, words.method, note, estimate, n_null)
    if method == "median":
        return _median_interval(defined, level=level, words=words, n_null=n_null)
    ends = _t_ends(defined, level) if method == "t" else _bca_ends(defined, level, n_draws=n_draws, seed=seed)
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
    estimate = _mean(defined) if defined.size else None
    if defined.size < MIN_RUNS:
        note = joined(f"{defined.size} pairs with both scores are too few for a test", words.note)
        return Comparison(
            Interval(None, None, level, words.estimand, words.method, note, estimate, n_null), None, better
        )
    low, high = _t_ends(defined, level)
    note = joined(_few(defined.size), _shape(defined, "t"), words.note)
    interval = Interval(low, high, level, words.estimand, words.method, note, estimate, n_null)
    return Comparison(interval, two_sided_p(_mean(defined), _standard_error(defined), defined.size - 1), better)


def two_sided_p(difference: float, standard_error: float, dof: int) -> float:
    """Return the p-value of a difference under Student's t; 1 where there is neither a difference nor a spread."""
    if standard_error == 0:
        return 1.0 if difference == 0 else 0.0
    return float(2 * stats.t.sf(abs(difference) / standard_error, dof))


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


def check_level(level: float) -> None:
    """Raise InputError unless the level is a share between 0 and 1."""
    if not 0 < level < 1:
        raise InputError(f"the level is {level}", where="interval", todo="Give a share between 0 and 1, e.g. 0.95.")


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
        "median": f"order statistics of {n} {unit}s",
    }
    missing = f"{n_null} of {n + n_null} {unit}s have no score and are left out" if n_null else ""
    return _Words(f"the {what} {score} of a {unit} of this procedure{among}", how[method], missing)


def _mean(values: Floats) -> float:
    return math.fsum(values.tolist()) / values.size


def _standard_error(values: Floats) -> float:
    """Return the standard error of the mean; 0 for equal values, whose mean may round away from them."""
    return 0.0 if np.ptp(values) == 0 else float(values.std(ddof=1) / math.sqrt(values.size))


def _t_ends(values: Floats, level: float) -> tuple[float, float]:
    half = float(stats.t.ppf((1 + level) / 2, values.size - 1)) * _standard_error(values)
    mean = _mean(values)
    return mean - half, mean + half


def _bca_ends(values: Floats, level: float, *, n_draws: int, seed: int) -> tuple[float, float]:
    """Return Efron's BCa ends of the mean of sorted values, its tails widened for few values (Hesterberg)."""
    n, mean = values.size, _mean(values)
    if np.ptp(values) == 0:
        return mean, mean
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    draws = np.sort(rng.multinomial(n, np.full(n, 1 / n), size=n_draws) @ values / n)
    deviation = values - mean
    acceleration = float((deviation**3).sum() / (6 * (deviation**2).sum() ** 1.5))
    # half of the draws that tie with the mean count as below it
    below = (np.searchsorted(draws, mean, "left") + np.searchsorted(draws, mean, "right")) / 2
    bias = stats.norm.ppf(np.clip(below, 0.5, n_draws - 0.5) / n_draws)
    tail = math.sqrt(n / (n - 1)) * stats.t.ppf((1 + level) / 2, n - 1)
    shifted = bias + np.array([-tail, tail])
    low, high = np.quantile(draws, stats.norm.cdf(bias + shifted / (1 - acceleration * shifted)))
    return float(low), float(high)


def _median_interval(values: Floats, *, level: float, words: _Words, n_null: int) -> Interval:
    """Return the narrowest symmetric pair of order statistics that holds the median with at least `level`."""
    n, estimate = values.size, float(np.median(values))
    # the ends are the k-th smallest and the k-th largest: both on one side with probability P(Binomial(n, 1/2) < k)
    k = int(stats.binom.ppf((1 - level) / 2, n, 0.5))
    if k < 1:
        note = joined(f"{n} runs are too few: even their whole range falls short of {level:.0%}", words.note)
        return Interval(None, None, level, words.estimand, words.method, note, estimate, n_null)
    exact = 1 - 2 * float(stats.binom.cdf(k - 1, n, 0.5))
    note = joined(f"covers {exact:.1%} exactly, the least of {level:.0%} or more that {n} runs can give", words.note)
    ends = float(values[k - 1]), float(values[n - k])
    return Interval(*ends, level, words.estimand, words.method, note, estimate, n_null)


def _few(n: int) -> str:
    return f"{n} runs are few: coverage is approximate" if n < FEW_RUNS else ""


def _shape(values: Floats, method: Method) -> str:
    """Say what the distribution of the scores does to an interval of their mean."""
    if np.ptp(values) == 0:
        return f"all {values.size} scores are equal, which says nothing about their spread"
    skewness = float(stats.skew(values, bias=False))
    if abs(skewness) <= _SKEWED:
        return ""
    name = "t" if method == "t" else "BCa"
    return (
        f"the scores are skewed ({skewness:+.1f}): the {name} interval may cover as little as 90 %, "
        "and a bad run so rare that none of these shows it is in no interval; the median is safer"
    )


def joined(*notes: str) -> str:
    """Join the notes that say something."""
    return "; ".join(note for note in notes if note)
