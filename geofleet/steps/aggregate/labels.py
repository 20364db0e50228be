"""How a layer calls its method, which options go together, and what an area may be."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from pathlib import Path

    from geofleet.config import AggregateConfig


def method_label(settings: AggregateConfig, k_from: Path | None, prior: Path | None) -> str:
    """Return how the layer calls its method; the core rule, where K came from and whether biases are taken out show.

    DBSCAN with one core rule everywhere is `dbscan-first` or `-after`, as in the paper; with the one that follows the
    densest place (`min_samples_share`) it is `dbscan-peaks`, or `dbscan-peaks-after`: never the name of the other.
    """
    if prior and settings.method != "joint":
        raise ConfigError(f"{settings.method} takes no prior map.", where="--prior", todo="Use --method joint.")
    if settings.method == "joint":
        if settings.correct_bias or settings.k or k_from:
            raise ConfigError(
                "joint fusion solves the bias of each pass itself and takes no K.",
                where="--correct-bias, --k, --k-from",
                todo="Leave them out.",
            )
        return "joint-prior" if prior else "joint"
    label = f"{_clustering(settings)}{'-corrected' * settings.correct_bias}"
    if settings.method not in {"kmeans", "kmedoids"}:
        if k_from or settings.k:
            raise ConfigError(
                f"{settings.method} takes no K.", where="--k", todo="Leave it out, or use kmeans or kmedoids."
            )
        return label
    if settings.k and k_from:
        raise ConfigError("K is given twice.", where="--k and --k-from", todo="Give one of them.")
    if settings.k and settings.semantic == "first":
        raise ConfigError(
            f"k={settings.k} is for all classes together, and semantic=first clusters each class by itself.",
            where="--k",
            todo="Use --k-from REFERENCE for the number of signs a class, or leave K out to have it chosen.",
        )
    return f"{label}-oracle-k" if k_from else f"{label}-k{settings.k}" if settings.k else label


def check_area(area: tuple[float, float, float, float] | None) -> tuple[float, float, float, float] | None:
    """Return an area that can be meant.

    Raises
    ------
    ConfigError
        A side is out of range, or the south is not south of the north.
    """
    if area is None:
        return None
    west, south, east, north = area
    if not (abs(west) <= 180 and abs(east) <= 180 and west != east and -90 <= south < north <= 90):  # noqa: PLR2004 - degrees
        raise ConfigError(
            f"{west:g},{south:g},{east:g},{north:g} is no area: it has no inside, or is not in degrees.",
            where="--area",
            todo="Give W,S,E,N, e.g. --area 24.93,60.16,24.96,60.18",
        )
    return float(west), float(south), float(east), float(north)


def _clustering(settings: AggregateConfig) -> str:
    if settings.method == "dbscan" and settings.min_samples_share > 0:
        return "dbscan-peaks" + "-after" * (settings.semantic == "after")
    return f"{settings.method}-{settings.semantic}"
