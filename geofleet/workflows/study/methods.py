"""The methods that a study compares: each is a name for settings of the aggregate step."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, get_args

from geofleet.config import AggregateConfig
from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from geofleet.config import Config

Upload = Literal["mean", "information"]

CLUSTERING = ("dbscan", "hdbscan", "kmeans", "kmedoids")
TABLE_2 = tuple(f"{name}-{order}" for name in CLUSTERING for order in ("first", "after"))
PEAKS, CORRECTED, JOINT, JOINT_PRIOR = "dbscan-peaks", "dbscan-corrected", "joint", "joint-prior"
PLAIN = {"min_samples_share": 0.0}
"""DBSCAN as the paper ran it: one core rule for all fleets. `geofleet aggregate` splits chains instead (PEAKS)."""


@dataclass(frozen=True, slots=True)
class Method:
    """A way from detections to a map.

    Parameters
    ----------
    label
        What tables and figures call it.
    settings
        Keys of the section `aggregate` that it sets, by name.
    upload
        What it reads of a detection: its `mean`, or its `information` form.
    has_oracle_k
        It is told the number of signs of the reference, as the paper did, which no real job knows.
    has_passes
        It reads where the cars drove: not seeing a sign is evidence.
    has_prior
        It starts from an outdated map.
    """

    label: str
    settings: Mapping[str, Any]
    upload: Upload = "mean"
    has_oracle_k: bool = False
    has_passes: bool = False
    has_prior: bool = False


def _methods() -> dict[str, Method]:
    methods = {
        f"{name}-{order}": Method(
            f"{name}-{order}", {"method": name, "semantic": order} | PLAIN, has_oracle_k=name.startswith("km")
        )
        for name in CLUSTERING
        for order in ("first", "after")
    }
    peaks: dict[str, Any] = {"method": "dbscan", "semantic": "first"}
    methods[PEAKS] = Method(PEAKS, peaks)
    methods[CORRECTED] = Method(CORRECTED, peaks | {"correct_bias": True}, "information")
    if JOINT not in get_args(AggregateConfig.model_fields["method"].annotation):
        return methods
    methods[JOINT] = Method(JOINT, {"method": "joint"}, "information", has_passes=True)
    methods[JOINT_PRIOR] = Method(JOINT_PRIOR, {"method": "joint"}, "information", has_passes=True, has_prior=True)
    return methods


METHODS: Mapping[str, Method] = MappingProxyType(_methods())


def default_methods(*labels: str) -> str:
    """Return those of some methods that there are, as `parse_methods` reads them."""
    return ",".join(label for label in labels if label in METHODS)


def parse_methods(text: str, *, option: str = "--methods") -> tuple[Method, ...]:
    """Read `dbscan,joint,…`, the value of an option; a clustering alone is meant semantic first.

    Raises
    ------
    ConfigError
        A name is unknown, or none is given.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    labels = [f"{name}-first" if name in CLUSTERING else name for name in names]
    for name, label in zip(names, labels, strict=True):
        if label not in METHODS:
            near = difflib.get_close_matches(name, [*CLUSTERING, *METHODS], n=1)
            todo = f"Did you mean {near[0]}?" if near else f"Methods are {', '.join(METHODS)}."
            raise ConfigError(f"unknown method {name!r}.", where=option, todo=todo)
    if not labels:
        raise ConfigError("no method is named.", where=option, todo=f"Methods are {', '.join(METHODS)}.")
    return tuple(METHODS[label] for label in dict.fromkeys(labels))


def with_settings(config: Config, method: Method) -> Config:
    """Return the settings of a world with those of a method."""
    aggregate = type(config.aggregate).model_validate(config.aggregate.model_dump() | dict(method.settings))
    return config.model_copy(update={"aggregate": aggregate})
