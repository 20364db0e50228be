"""Write docs/results.md, its figures and the table of the README from what the studies found, no number by hand.

    make results        (or: python scripts/write_results.py data/processed/study)

A study that is not there leaves its section, or the table, as it was.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from geofleet.workflows.study.fleet_size import PAPER_METHOD
from geofleet.workflows.study.methods import JOINT, PEAKS
from geofleet.workflows.study.paper import paper_curve, paper_table

if TYPE_CHECKING:
    from collections.abc import Callable

    Row = dict[str, str]

DOCS = Path(__file__).resolve().parents[1] / "docs"
README = DOCS.parent / "README.md"
FIGURES = DOCS / "figures"
GOOD_F1 = 0.9  # named in the tables
README_SIZES = (5, 10, 20, 50)
README_METHODS = {
    PAPER_METHOD: "the same method here",
    PEAKS: "`geofleet aggregate`",
    JOINT: "`geofleet aggregate --method joint`",
}
HEAD = """# Results

Written by `make results` from the output of `make study` and `make environments`; no number here is written by hand.
Signs are real; **fleets and detections are simulated**. GOSPA_M and F1 are means over fleets ± standard deviation;
[paper.md](paper.md) says where they differ from the paper's and why, [uncertainty.md](uncertainty.md) how far an
interval can be trusted. `upload` is what a method reads of a detection: its mean, or its information form.
"""


def main() -> None:
    """Write the page anew, a section a study."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "data/processed/study")
    FIGURES.mkdir(exist_ok=True)
    path = DOCS / "results.md"
    old = path.read_text(encoding="utf-8") if path.is_file() else ""
    sections = [section(name, render, folder / name, old) for name, render in SECTIONS.items()]
    path.write_text("\n".join([HEAD, *filter(None, sections)]), encoding="utf-8")
    if (folder / "fleet-size" / "_manifest.json").is_file():
        mark, end = "<!-- fewer cars, by make results -->\n", "<!-- end of fewer cars -->"
        before, _, rest = README.read_text(encoding="utf-8").partition(mark)
        _, _, after = rest.partition(end)
        text = f"{before}{mark}{fewer_cars(read_summary(folder / 'fleet-size'))}\n{end}{after}"
        README.write_text(text, encoding="utf-8")


def fewer_cars(rows: list[Row]) -> str:
    """Return the table of the README: what fleets of some sizes reach, the paper's and by three methods."""
    paper = {(p.n_vehicles, p.score): p.mean for name in ("f1", "gospa_m") for p in paper_curve(name)}
    lines = [
        ["the paper, DBSCAN, as printed", *(f"{paper[v, 'f1']:.3f}, {paper[v, 'gospa_m']:.3f}" for v in README_SIZES)]
    ]
    for method, what in README_METHODS.items():
        cells = [
            ", ".join(
                f"{float(score(rows, name, method=method, n_vehicles=str(v))['mean']):.3f}"
                for name in ("f1", "gospa_m")
            )
            for v in README_SIZES
        ]
        lines.append([what, *cells])
    return table(["F1 and GOSPA_M (m) with", *(f"{v} cars" for v in README_SIZES)], lines)


def section(name: str, render: Callable[[list[Row]], str], study: Path, old: str) -> str:
    """Return the section of a study, or what stood there when the study has not been run."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    if not (study / "_manifest.json").is_file():
        kept = re.search(f"{re.escape(begin)}.*{re.escape(end)}\n", old, flags=re.DOTALL)
        sys.stderr.write(f"{study} is not there: its section {'stays as it was' if kept else 'is left out'}\n")
        return kept[0] if kept else ""
    for figure in study.glob("*.svg"):
        shutil.copyfile(figure, FIGURES / figure.name)
    rows = read_summary(study)
    return f"{begin}\n{render(rows)}\n\n*{provenance(study, rows)}*\n{end}\n"


def read_summary(study: Path) -> list[Row]:
    """Return the rows of a study's summary."""
    with (study / "summary.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def provenance(study: Path, rows: list[Row]) -> str:
    """Say what was run."""
    settings = json.loads((study / "_manifest.json").read_text(encoding="utf-8"))["settings"]
    several = {name: ", ".join(dict.fromkeys(row[name] for row in rows)) for name in ("scenario", "tracker", "place")}
    return (
        f"Scenario {several['scenario']}; tracker {several['tracker']}; {several['place']}; {settings['n_replicates']} "
        f"fleets, seed {settings['seed']}{'; signs in view' if settings['in_view'] else ''}."
    )


def table(names: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table."""
    return "\n".join("| " + " | ".join(row) + " |" for row in [names, ["---"] * len(names), *rows])


def score(rows: list[Row], name: str, **labels: str) -> Row:
    """Return the summary of one score of one group."""
    return next(r for r in rows if r["score"] == name and all(r[key] == value for key, value in labels.items()))


def spread(row: Row, digits: int = 3) -> str:
    """Return mean ± standard deviation."""
    if not row["mean"]:
        return "-"
    return f"{float(row['mean']):.{digits}f} ± {float(row['sd'] or 0):.{digits}f}"


def compare(rows: list[Row]) -> str:
    """Return Table 2."""
    paper, lines = paper_table(), []
    for method in dict.fromkeys(row["method"] for row in rows):
        own = {name: score(rows, name, method=method) for name in ("precision", "recall", "f1", "gospa_m")}
        printed = paper.get(method)
        gospa_m = own["gospa_m"]
        interval = (
            f"{float(gospa_m['mean_low']):.3f} … {float(gospa_m['mean_high']):.3f}" if gospa_m["mean_low"] else "-"
        )
        lines.append(
            [f"`{method}`", gospa_m["upload"]]
            + [f"{100 * float(own[name]['mean']):.1f}" for name in ("precision", "recall")]
            + [spread(own["f1"]), spread(gospa_m), interval, f"{float(gospa_m['median']):.3f}"]
            + (
                [
                    f"{100 * printed['precision']:.1f} / {100 * printed['recall']:.1f}",
                    f"{printed['f1']:.3f}",
                    f"{printed['gospa_m']:.3f}",
                ]
                if printed
                else ["", "", ""]
            )
        )
    names = ["method", "upload", "P %", "R %", "F1", "GOSPA_M (m)", "95 % interval", "median"]
    names += ["paper: P / R %", "F1", "GOSPA_M"]
    return (
        f"## Table 2: methods at {rows[0]['n_vehicles']} vehicles\n\n{table(names, lines)}\n\n"
        "All rows have the same detections, in pieces where the paper's tracker breaks off. `joint` is meant for "
        "tracks that hold (`--tracker kalman`): [fusion-results.md](fusion-results.md) has its scores there.\n\n"
        "![Methods of Table 2 beside the paper's](figures/methods.svg)"
    )


def fleet_size(rows: list[Row]) -> str:
    """Return Figures 3 to 5."""
    paper = {(p.n_vehicles, p.score): p for name in ("f1", "gospa_m") for p in paper_curve(name)}
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines, within = [], 0
    for size in dict.fromkeys(row["n_vehicles"] for row in rows):
        cells = [size]
        for method in methods:
            own = {name: score(rows, name, method=method, n_vehicles=size) for name in ("f1", "gospa_m")}
            cells += [
                f"{float(own['f1']['mean']):.3f}",
                f"{spread(own['gospa_m'])} ({float(own['gospa_m']['median']):.3f})",
            ]
        point = paper[int(size), "gospa_m"]
        mean = float(score(rows, "gospa_m", method=PAPER_METHOD, n_vehicles=size)["mean"])
        z = (mean - point.mean) / (point.sd or 1.0)
        within += abs(z) <= 1
        lines.append([*cells, f"{paper[int(size), 'f1'].mean:.3f}", f"{point.mean:.3f} ± {point.sd:.3f}", f"{z:+.2f}"])
    names = ["V"] + [name for method in methods for name in (f"`{method}` F1", "GOSPA_M (median)")]
    names += ["paper: F1", "GOSPA_M", f"z of `{PAPER_METHOD}`"]
    pictures = ("3-f1", "F1"), ("4-counts", "TP, FP and FN"), ("5-gospa_m", "GOSPA_M")
    return (
        f"## Figures 3 to 5: the size of the fleet\n\n{table(names, lines)}\n\n`{PAPER_METHOD}` lies within the "
        f"paper's mean ± 1 standard deviation at **{within} of {len(lines)}** fleet sizes (z: distance in its standard "
        "deviations).\n\n"
        + "\n\n".join(f"![{what} over the size of the fleet](figures/figure-{name}.svg)" for name, what in pictures)
    )


def sweep(rows: list[Row]) -> str:
    """Return the sensitivity to the share of right classes."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    lines = []
    for setting in dict.fromkeys(row["setting"] for row in rows):
        cells = [setting.partition("=")[2]]
        for method in methods:
            own = {name: score(rows, name, method=method, setting=setting) for name in ("f1", "gospa_m")}
            cells.append(f"{float(own['f1']['mean']):.3f}, {spread(own['gospa_m'])}")
        lines.append(cells)
    printed = ["paper"] + [f"{paper_table()[m]['f1']:.3f}, {paper_table()[m]['gospa_m']:.3f}" for m in methods]
    names = [f"`{name}`" for name in ("semantic_rate", *methods)]
    return (
        "## How much depends on the share of wrong classes\n\nF1 and GOSPA_M (m) at "
        f"{rows[0]['n_vehicles']} vehicles, by `semantic_rate`, the share of tracks that carry the right class. A "
        "cluster of wrong classes is a sign of its own to a method that is told how many signs of each class there "
        f"are: K-Means semantic-first stands and falls with this share.\n\n{table(names, [*lines, printed])}\n\n"
        "![Scores over semantic_rate](figures/sweep.svg)"
    )


def least_fleet(rows: list[Row], **labels: str) -> str:
    """Return the least fleet from which on the mean F1 is good at every size tried, `none` where there is none."""
    least = "none"
    for row in reversed([r for r in rows if r["score"] == "f1" and all(r[key] == v for key, v in labels.items())]):
        if not row["mean"] or float(row["mean"]) < GOOD_F1:
            break
        least = row["n_vehicles"]
    return least


def curves(title: str, by: str, what: str, figure: str) -> Callable[[list[Row]], str]:
    """Return what writes a section of curves: a row a group and method, a column a fleet size."""

    def render(rows: list[Row]) -> str:
        sizes = list(dict.fromkeys(row["n_vehicles"] for row in rows))
        lines = []
        for group in dict.fromkeys(row[by] for row in rows):
            for method in dict.fromkeys(row["method"] for row in rows):
                first = score(rows, "f1", method=method, **{by: group})
                cells = [group, f"`{method}`", first["upload"], first["tracker"]]
                for size in sizes:
                    own = [
                        score(rows, name, method=method, n_vehicles=size, **{by: group}) for name in ("f1", "gospa_m")
                    ]
                    cells.append(
                        ", ".join(
                            f"{float(one[which]):.3f}" if one[which] else "-"
                            for one, which in zip(own, ("mean", "median"), strict=True)
                        )
                    )
                cells.append(least_fleet(rows, method=method, **{by: group}))
                lines.append(cells)
        names = [by, "method", "upload", "tracker", *(f"V = {size}" for size in sizes), f"F1 ≥ {GOOD_F1} from"]
        body = f"{what} Mean F1 and median GOSPA_M (m):\n\n{table(names, lines)}"
        return f"## {title}\n\n{body}\n\n![{title}](figures/{figure}.svg)"

    return render


SECTIONS: dict[str, Callable[[list[Row]], str]] = {
    "compare": compare,
    "fleet-size": fleet_size,
    "sweep-semantic_rate": sweep,
    "environments": curves(
        "Urban, highway and rural roads",
        "place",
        "The paper's first open question. Ingolstadt, the A9 and Hansbeke need the maps in `../shared/data`, which may "
        "not be passed on: only scores are shown.",
        "environments",
    ),
    "mixed-fleets": curves(
        "Mixed fleets",
        "setting",
        "The paper's second open question: shares of high-end cars (GNSS 0.3 m, a calibrated camera) and telephones "
        "(GNSS 3.5 m, 60 m range) in Helsinki; the rest carries the camera of the scenario `urban` "
        "(`geofleet/scenarios/mixed.toml`).",
        "mixed-fleets",
    ),
}

if __name__ == "__main__":
    main()
