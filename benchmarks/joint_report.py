"""Write `docs/fusion-results.md` and its figures from the figures that `benchmarks/joint.py` kept.

.venv/bin/python benchmarks/joint_report.py [--fleets DIR]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from joint import RESULTS
from joint_figures import draw_convergence, draw_fleet_sizes, draw_map, draw_reliability

if TYPE_CHECKING:
    from collections.abc import Iterable

DOCS = Path(__file__).parent.parent / "docs"
SCENARIOS = ("paper-ideal", "paper", "paper-50m")
METHODS = ("dbscan-first", "dbscan-corrected", "joint")
HEAD = """# Joint fusion, measured

**All fleets below are simulated** (`benchmarks/joint.py`; this page is written by `benchmarks/joint_report.py` from
`benchmarks/results/joint.json`). Drive A is the demo's; drive B was used to develop nothing but how a stale
prior is read (below: seeds that nobody looked at). A map is scored against the signs that at least one pass of the
fleet reported: what nobody reported is beyond every method. With a prior map, signs
that it holds count too. Gate 2 m, equal class. *Known association* is the same solver told which
track is of which sign; it pays for nothing else, so what separates it from the truth is noise and the GNSS offset that
a fleet has in common. *DBSCAN* is the paper's (`dbscan-first` of a study); *DBSCAN corrected* is DBSCAN after
`--correct-bias` with the core rule that `geofleet aggregate` has, on the same detections and passes.

The number of replicates stands beside every figure; few of them settle no 1st percentile. A prior map holds the signs
that at least half of the passes of the largest fleet report, less what is outdated.
"""

PAIRED = """### Joint and corrected DBSCAN on the same runs

Median GOSPA_M (m), and a bootstrap over runs of the difference of medians.
"""
TABLE = """## The command's own table

Written from what `make fusion-table` found: `geofleet study compare --methods dbscan,dbscan-corrected,joint --vehicles
1,2,3,5,8,10,15,20,30,50 --scenario paper-ideal,paper,paper-50m --tracker kalman --in-view`, ten fleets, seed 0, past
both drives. Maps are scored against all signs that a pass of fifty had in view, reported by the small fleet or not.
Two of the 30 past drive B are in view for a single frame of a pass, and no tracker sends a track of fewer than three:
the best F1 there is 0.966. DBSCAN asks for three detections, so that two passes give it no sign.
Mean F1 / mean GOSPA_M (median), m; a fleet without any match has no GOSPA_M and is left out of its mean.
"""
FRESH = """### Seeds that nobody looked at

The second drive's runs of the seed above were looked at while the use of a stale prior was mended; these were not.
Corrected DBSCAN has the paper's core rule in this table. Mean F1 / median GOSPA_M (m).
"""
COMMON = """### What the common offset costs

The mean of V offsets of 1.3 m an axis lies beyond the gate of 2 m with probability exp(-V 2² / (2 · 1.3²)): 31 % for
one pass, 9 % for two, 2.9 % for three, 0.3 % for five. Then hardly a sign matches, and F1 is near 0: the best mean F1
of three passes is about 0.97, whatever is done with their detections. What known association loses comes back when
the common offset is taken out of its map, which only an anchor (a prior map, an RTK car) can do.
"""
HONESTY = """Relative places: the common translation of the map is taken out. The bound is Bayesian, with known
association, at the information that tracks send. Root of the mean square over all runs, in which one run that went
wrong weighs heavily; the ratio of medians stands beside it. Normalised error squared is 2 when covariances are honest.
"""
HARD = """DBSCAN corrected and joint have the same detections; of means alone DBSCAN takes no bias out. Cases
of five runs were measured before passes with gross faults were let go, which touches one sound pass in a thousand.
Mean F1 / median GOSPA_M (m). `benchmarks/joint_cases.py` lists what is set.
"""
NAMED = """Faulty passes that the command names, and sound ones. Of what `paper-ideal` declares, 10 m and 5° are no more
than 3.4 standard deviations, and of offsets drawn with 10 m a good part is small: these cannot be told. A pass that
no other meets is named too, and not counted here.
"""
OTHER_DRAWS = """Of DBSCAN the first 20 to 60 runs, so that its medians are of other draws; the same runs are compared
below."""


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _score(of: dict[str, Any] | None, *, best: str = "") -> str:
    if of is None:
        return ""
    gospa_m = "none" if of["gospa_m_median"] > 90 else f"{of['gospa_m_median']:.3f}"  # noqa: PLR2004 - nothing matched
    return f"{of['f1_mean']:.3f} / {gospa_m}{best}"


def _bars(bars: dict[str, Any]) -> str:
    parts = []
    for name, by_size in bars.items():
        rows = []
        for v in sorted((v for v in by_size if "joint" in by_size[v]), key=int):
            of = by_size[v]
            ratio = of["joint"]["gospa_m_median"] / of["known"]["gospa_m_median"]
            rows.append(
                [
                    v,
                    _score(of.get("dbscan")),
                    _score(of.get("dbscan corrected")),
                    _score(of["joint"]),
                    f"{of['joint']['f1_p1']:.3f}",
                    _score(of["known"]),
                    f"{ratio:.2f}",
                    _score(of.get("joint with a stale prior")),
                    f"{of['unsettled']}",
                    str(of["joint"]["n"]),
                ]
            )
        head = (
            "passes",
            "DBSCAN",
            "DBSCAN corrected",
            "**joint**",
            "1st percentile of F1",
            "known association",
            "ratio",
            "joint, stale prior",
            "unsettled",
            "runs",
        )
        parts.append(f"### {name}\n\nMean F1 / median GOSPA_M (m). {OTHER_DRAWS}\n\n" + _table(head, rows))
    return "\n".join(parts)


def _paired(bars: dict[str, Any]) -> str:
    """Return joint beside corrected DBSCAN on the same runs, where there are many."""
    rows = [
        [
            name,
            v,
            str(pair["n"]),
            f"{pair['joint']:.3f}",
            f"{pair['rival']:.3f}",
            f"{pair['low']:+.3f} to {pair['high']:+.3f}",
            f"{100 * pair['won']:.0f} %",
        ]
        for name, by_size in bars.items()
        for v in sorted(by_size, key=int)
        for pair in (by_size[v]["paired"],)
    ]
    head = ("fleet", "passes", "runs", "joint", "DBSCAN corrected", "difference, 95 %", "runs in which joint is nearer")
    return _table(head, rows) if rows else ""


def _study(table: dict[str, Any]) -> str:
    """Return what `study compare` found, a table a scenario and drive."""
    parts = []
    for world, by_size in sorted(table.items(), key=lambda item: SCENARIOS.index(item[0].split(",")[0])):
        methods = sorted(next(iter(by_size.values())), key=METHODS.index)
        rows = [[v, *(_means(by_size[v][method]) for method in methods)] for v in sorted(by_size, key=int)]
        parts.append(f"### {world}\n\n" + _table(("passes", *(f"`{method}`" for method in methods)), rows))
    return "\n".join(parts)


def _means(of: dict[str, dict[str, float]]) -> str:
    f1, gospa_m = of["f1"], of["gospa_m"]
    if "mean" not in gospa_m:
        return f"{f1['mean']:.3f} / none"
    lost = f", {gospa_m['n_null']:.0f} left out" if gospa_m["n_null"] else ""
    return f"{f1['mean']:.3f} / {gospa_m['mean']:.3f} ({gospa_m['median']:.3f}{lost})"


def _fresh(fresh: dict[str, Any]) -> str:
    rows = [
        [
            name,
            v,
            str(of["joint"]["n"]),
            _score(of["joint"]),
            f"{of['joint']['gospa_m_median'] / of['known']['gospa_m_median']:.2f}",
            _score(of.get("dbscan corrected")),
            _score(of.get("stale prior alone")),
            _score(of.get("joint with a stale prior")),
        ]
        for name, by_size in fresh.items()
        for v in sorted(by_size, key=int)
        for of in (by_size[v],)
    ]
    head = ("fleet", "passes", "runs", "**joint**", "ratio to known association", "DBSCAN corrected")
    return _table((*head, "stale prior alone", "**joint, stale prior**"), rows)


def _common(bars: dict[str, Any]) -> str:
    """Return what known association loses to the offset that the fleet has in common."""
    rows = [
        [
            name,
            v,
            str(of["known"]["n"]),
            _score(of["joint"]),
            _score(of["known"]),
            _score(of["known, no common offset"]),
        ]
        for name, by_size in bars.items()
        for v in sorted(by_size, key=int)
        if "known, no common offset" in (of := by_size[v])
    ]
    head = ("fleet", "passes", "runs", "**joint**", "known association", "the same less the common offset")
    return _table(head, rows) if rows else ""


def _honesty(honesty: dict[str, Any]) -> str:
    rows = []
    for name, by_size in honesty.items():
        for v in sorted(by_size, key=int):
            of = by_size[v]
            rows.append(
                [
                    name,
                    v,
                    str(of["n"]),
                    f"{of['relative_rmse_m']:.3f}",
                    f"{of['known_rmse_m']:.3f}",
                    f"{of['bound_m']:.3f}",
                    f"{of['relative_rmse_m'] / of['bound_m']:.2f}",
                    f"{of['relative_median_m'] / of['bound_median_m']:.2f}",
                    f"{of['nees_mean']:.2f}",
                    f"{100 * of['coverage_90']:.1f} %",
                    f"{of['brier']:.4f} ({of['brier_of_base_rate']:.4f})",
                ]
            )
    head = (
        "fleet",
        "passes",
        "runs",
        "relative RMSE (m)",
        "known association",
        "bound",
        "ratio",
        "ratio of medians",
        "mean of normalised error squared",
        "in 90 % ellipse",
        "Brier (of the base rate)",
    )
    return _table(head, rows)


def _priors(prior: dict[str, Any]) -> str:
    rows = [
        [
            name,
            v,
            fault,
            _score(of["prior alone"]),
            _score(of["with"]),
            _score(of["without"]),
            f"{100 * of['coverage_90']:.0f} %",
            str(of["with"]["n"]),
        ]
        for name, by_size in prior.items()
        for v in sorted(by_size, key=int)
        for fault, of in by_size[v].items()
    ]
    return _table(
        ("fleet", "passes", "prior", "prior alone", "joint with it", "joint without", "in 90 % ellipse", "runs"), rows
    )


def _robustness(hard: dict[str, Any]) -> str:
    rows = [
        [
            name,
            v,
            _score(of.get("dbscan corrected", of.get("dbscan by default", of.get("dbscan")))),
            _score(of["joint"]),
            f"{of['paired']['low']:+.3f} to {of['paired']['high']:+.3f}",
            _score(of["known"]),
            f"{100 * of['coverage_90']:.0f} %",
            str(of["joint"]["n"]),
        ]
        for name, by_size in hard.items()
        for v, of in sorted(by_size.items(), key=lambda item: int(item[0]))
    ]
    return _table(
        (
            "case",
            "passes",
            "DBSCAN corrected",
            "**joint**",
            "difference of medians, 95 %",
            "known association",
            "in 90 % ellipse",
            "runs",
        ),
        rows,
    )


def _named(hard: dict[str, Any]) -> str:
    """Return how many passes with a fault are named, where there are any."""
    rows = [
        [name, v, f"{told['faulty named']} of {told['faulty']}", f"{told['sound named']} of {told['sound']}"]
        for name, by_size in hard.items()
        for v, of in sorted(by_size.items(), key=lambda item: int(item[0]))
        if (told := of.get("named", {})).get("faulty")
    ]
    return _table(("case", "passes", "faulty ones named", "sound ones named"), rows) if rows else ""


def _cost(cost: dict[str, Any]) -> str:
    rows = [
        [
            f"{of['signs']} by {of['passes']}",
            f"{of['tracks']:,.0f}",
            f"{of['seconds']:.1f}",
            f"{of['cpu_seconds']:.1f}",
            f"{of['peak_mb']:.0f}",
            f"{of['rounds']:.0f}",
            "yes" if of["settled"] else "no",
        ]
        for of in cost["two cores"]
    ]
    return _table(("signs by passes", "tracks", "seconds", "of a CPU", "peak (MB)", "rounds", "settled"), rows)


def page(results: dict[str, Any]) -> str:
    """Return the page."""
    parts = [HEAD]
    if "bars" in results:
        parts += ["## Fleet sizes\n", "![Fleet sizes](fusion-fleet-sizes.png)\n", _bars(results["bars"])]
        parts += [PAIRED, _paired(results["bars"]), COMMON, _common(results["bars"])]
    if "fresh" in results:
        parts += [FRESH, _fresh(results["fresh"])]
    if "table" in results:
        parts += [TABLE, _study(results["table"])]
    if "honesty" in results:
        parts += [
            "## Efficiency and honesty\n",
            HONESTY,
            _honesty(results["honesty"]),
            "![Reliability of existence](fusion-reliability.png)\n",
            "![Error ellipses](fusion-ellipses.png)\n",
            "![Convergence](fusion-convergence.png)\n",
        ]
    if "prior" in results:
        parts += [
            "## Prior maps\n",
            "Outdated copies as `geofleet stale` makes them, sigma 0.15 m. Mean F1 / median GOSPA_M (m).\n",
            _priors(results["prior"]),
        ]
    if "robustness" in results:
        parts += [
            "## Fleets that are not as they say\n",
            HARD,
            _robustness(results["robustness"]),
        ]
        if named := _named(results["robustness"]):
            parts += [NAMED, named]
    if "cost" in results:
        parts += [
            "## Cost\n",
            "Made tracks, all in one run, two shared cores (`benchmarks/joint_cost.py`).\n",
            _cost(results["cost"]),
        ]
    return "\n".join(parts)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fleets", type=Path, default=Path("data/processed/benchmark-fleets"))
    fleets = parser.parse_args().fleets
    results = json.loads(RESULTS.read_text())
    if "bars" in results:
        draw_fleet_sizes(results["bars"], DOCS / "fusion-fleet-sizes")
        draw_reliability(results["honesty"], DOCS / "fusion-reliability")
    draw_map(fleets, DOCS / "fusion-ellipses")
    draw_convergence(fleets, DOCS / "fusion-convergence")
    (DOCS / "fusion-results.md").write_text(page(results))


if __name__ == "__main__":
    main()
