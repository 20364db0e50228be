"""One frozen tree of settings, read from TOML.

A scenario is a TOML file with the sections below; it starts from another one (`base`, `paper` unless it says
otherwise) and overrides what it names. Every default lives in `scenarios/paper.toml` and nowhere else. Key names are
unique over all sections, so `--set tracker=kalman` needs no section.

Beside the sections stand kinds of sensors in a mixed fleet: `[mixed.NAME]` with the `share` of the vehicles that carry
it and the keys of `[sensor]` that differ; what the shares leave has `[sensor]` as it stands.
"""

from __future__ import annotations

import difflib
import hashlib
import tomllib
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, WrapValidator, model_validator
from pydantic_core import PydanticCustomError

from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Mapping

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Rate = Annotated[float, Field(ge=0, le=1)]
LEAST_SPACING_M, MOST_FRAMES_HZ, MOST_RANGE_M, MOST_PER_KM = 0.01, 1000, 10_000, 10_000
"""Beyond these a key is a slip of the pen, and a run would fill the memory before anyone noticed."""
ROOT_SCENARIO = "paper"
MIXED = "mixed"


@dataclass(frozen=True, slots=True)
class Off:
    """The value at which an option shapes nothing: left out of the digest, so that runs keep names as options grow."""

    value: Any


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")

    def options_off(self) -> set[str]:
        """Return the keys that are at the value that is off."""
        return {
            name
            for name, field in type(self).model_fields.items()
            if any(isinstance(mark, Off) and mark.value == getattr(self, name) for mark in field.metadata)
        }


class SceneConfig(_Section):
    """Which signs a study simulates and scores."""

    corridor_m: Positive
    groups: Annotated[tuple[Annotated[str, Field(min_length=1)], ...], Field(min_length=1)]
    respect_facing: Annotated[bool, Off(value=False)]
    billboards_per_km: Annotated[float, Field(ge=0, le=MOST_PER_KM), Off(0.0)]
    billboard_share: Annotated[tuple[Rate, Rate], Off((0.3, 0.6))]


class FleetConfig(_Section):
    """How vehicles follow the drive."""

    frame_spacing_m: Annotated[float, Field(ge=LEAST_SPACING_M, allow_inf_nan=False)]
    heading_baseline_m: Positive
    speed_mps: Positive
    lateral_sigma_m: NonNegative
    lateral_correlation_m: Positive
    speed_factor_sigma: NonNegative
    headway_s: NonNegative
    drives: Annotated[Literal["one", "all"], Off("one")]
    direction: Annotated[Literal["forward", "backward", "both"], Off("forward")]
    opposite_lane_m: Annotated[Finite, Off(3.5)]
    frame_rate_hz: Annotated[float, Field(ge=0, le=MOST_FRAMES_HZ), Off(0.0)]
    speed_profile: Annotated[Literal["constant", "recorded"], Off("constant")]


class SensorConfig(_Section):
    """What a camera sees and how wrong it is (paper, "Detection Simulation")."""

    sensor_kind: str
    range_m: Annotated[float, Field(gt=0, le=MOST_RANGE_M)]
    fov_deg: Annotated[float, Field(gt=0, le=360)]
    gnss_sigma_m: NonNegative
    heading_sigma_deg: NonNegative
    range_bias_sigma_m: NonNegative
    bearing_bias_sigma_deg: NonNegative
    range_noise_sigma_m: NonNegative
    bearing_noise_sigma_deg: NonNegative
    false_negative_rate: Rate
    semantic_rate: Rate
    semantic_draw: Literal["track", "frame"]
    ghost_rate_per_ha: NonNegative
    gnss_drift_sigma_m: Annotated[NonNegative, Off(0.0)]
    gnss_drift_correlation_s: Annotated[Positive, Off(60.0)]
    wrong_fixes_per_km: Annotated[float, Field(ge=0, le=MOST_PER_KM), Off(0.0)]
    wrong_fix_length_m: Annotated[Positive, Off(50.0)]
    wrong_fix_sigma_m: Annotated[NonNegative, Off(10.0)]
    fade_range_m: Annotated[NonNegative, Off(0.0)]
    fade_width_m: Annotated[Positive, Off(10.0)]
    occluded_share: Annotated[float, Field(ge=0, lt=1), Off(0.0)]
    occlusion_frames: Annotated[float, Field(ge=1, allow_inf_nan=False), Off(5.0)]
    confusion: Annotated[Literal["uniform", "group"], Off("uniform")]
    confusion_in_group: Annotated[Rate, Off(0.8)]
    range_bias_m: Annotated[Finite, Off(0.0)]
    bearing_bias_deg: Annotated[Finite, Off(0.0)]
    range_bias_drift_sigma_m: Annotated[NonNegative, Off(0.0)]
    bearing_bias_drift_sigma_deg: Annotated[NonNegative, Off(0.0)]
    bias_drift_correlation_s: Annotated[Positive, Off(60.0)]
    ghost_tracks_per_km: Annotated[float, Field(ge=0, le=MOST_PER_KM), Off(0.0)]
    ghost_track_frames: Annotated[float, Field(ge=1, allow_inf_nan=False), Off(8.0)]
    declares: Annotated[Literal["own", "fleet"], Off("own")]
    declared_sigma_scale: Annotated[Positive, Off(1.0)]


def _true_false_or_auto(value: Any, read: Callable[[Any], Any]) -> Any:
    """Read either; a fault is told once, not once a kind of value."""
    try:
        return read(value)
    except ValidationError:
        raise PydanticCustomError("true_false_or_auto", "Input should be true, false or auto") from None


class TrackingConfig(_Section):
    """How a vehicle turns frames into tracks (paper, "Temporal Tracking and Fusion")."""

    tracker: Literal["paper", "kalman", "ideal"]
    track_gate_m: Positive
    track_reference: Literal["last", "mean"]
    max_missed_frames: Annotated[int, Field(ge=0)]
    min_track_frames: Annotated[int, Field(ge=1)]
    end_on_leaving_view: bool
    track_gate_chi2: Annotated[Positive, Off(13.8)]
    merge_gate_chi2: Annotated[Positive, Off(13.8)]
    class_error_rate: Annotated[float, Field(gt=0, lt=1), Off(0.05)]
    send_information: Annotated[bool | Literal["auto"], WrapValidator(_true_false_or_auto), Off("auto")]
    split_track_rate: Annotated[Rate, Off(0.0)]

    @property
    def sends_information(self) -> bool:
        """Whether a vehicle sends the information form beside the mean; left to itself, the Kalman tracker does."""
        return self.tracker == "kalman" if self.send_information == "auto" else self.send_information


class AggregateConfig(_Section):
    """How detections of many passes become signs."""

    method: Literal["dbscan", "hdbscan", "kmeans", "kmedoids", "joint"]
    semantic: Literal["first", "after"]
    eps_m: Positive
    min_samples: Annotated[int, Field(ge=1)]
    min_samples_share: Rate
    min_cluster_size: Annotated[int, Field(ge=2)]
    k: Annotated[int, Field(ge=0)]
    max_k: Annotated[int, Field(ge=1)]
    min_support: Annotated[int, Field(ge=1)]
    min_support_share: Rate
    correct_bias: Annotated[bool, Off(value=False)]
    unknown_classes: Annotated[Literal["keep", "reject"], Off("keep")]
    assumed_gnss_sigma_m: Annotated[Positive, Off(2.0)]
    prior_sigma_m: Annotated[Positive, Off(0.15)]
    tile_zoom: Annotated[int, Field(ge=12, le=20)]


class EvaluateConfig(_Section):
    """How a map is scored."""

    gate_m: Positive
    match_on: Literal["class", "concept", "none"]
    correlation_m: Annotated[float, Field(gt=0, allow_inf_nan=False), Off(100.0)]


class SensorKind(_Section):
    """A kind of sensor in a mixed fleet: the share of the vehicles that carry it, and the sensor."""

    share: Rate
    sensor: SensorConfig


class Config(_Section):
    """Everything that shapes a study."""

    scenario: str
    scene: SceneConfig
    fleet: FleetConfig
    sensor: SensorConfig
    tracking: TrackingConfig
    aggregate: AggregateConfig
    evaluate: EvaluateConfig
    mixed: dict[str, SensorKind] = {}

    @model_validator(mode="after")
    def _shares_are_a_fleet(self) -> Config:
        total = sum(kind.share for kind in self.mixed.values())
        if total > 1 + 1e-9:  # shares are written as decimals
            raise ValueError(f"the shares of [{MIXED}] add up to {total:g}, more than the whole fleet")
        return self

    def digest(self, *sections: str) -> str:
        """Return 16 hex digits of the SHA-256 of some sections (all by default): what shapes a run or a step.

        Options that are off are left out.
        """
        off: dict[str, Any] = {name: getattr(self, name).options_off() for name in SECTIONS}
        off[MIXED] = {name: {"sensor": kind.sensor.options_off()} for name, kind in self.mixed.items()} or True
        text = self.model_dump_json(include=set(sections) or None, exclude=off)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


SECTIONS: dict[str, type[_Section]] = {
    name: field.annotation
    for name, field in Config.model_fields.items()
    if isinstance(field.annotation, type) and issubclass(field.annotation, _Section)
}
_SECTION_OF = {key: name for name, section in SECTIONS.items() for key in section.model_fields}


def packaged_scenarios() -> dict[str, Path]:
    """Return the TOML file of every packaged scenario by name."""
    folder = Path(str(resources.files("geofleet.scenarios")))
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def load_config(scenario: str | Path = ROOT_SCENARIO, overrides: Mapping[str, Any] | Iterable[str] = ()) -> Config:
    """Read a scenario and apply overrides.

    Parameters
    ----------
    scenario
        Name of a packaged scenario, or path of a TOML file.
    overrides
        Key to value, or `key=value` texts; a key may be written with its section (`sensor.range_m`) or without.

    Raises
    ------
    ConfigError
        The scenario, a section or a key is unknown, or a value is out of range.
    """
    path = _find(scenario)
    tree = _read(path, seen=())
    pairs = overrides.items() if hasattr(overrides, "items") else (_split_override(text) for text in overrides)
    given = set()
    for key, value in pairs:
        *place, name = _locate(key, where="--set")
        _reach(tree, place)[name] = value
        given.add((*place, name))
    _fix_core(tree, {name for *section, name in given if section == ["aggregate"]})
    mixed = {
        name: {"share": keys.pop("share", None), "sensor": {**tree["sensor"], "sensor_kind": name, **keys}}
        for name, keys in tree.pop(MIXED, {}).items()
    }
    try:
        return Config.model_validate({"scenario": path.stem, **tree, MIXED: mixed})
    except ValidationError as error:
        raise _explained(error, path, given) from None


def _find(scenario: str | Path, beside: Path | None = None) -> Path:
    """Return the file of a scenario; a `base` is looked for beside the file that names it."""
    packaged = packaged_scenarios()
    if str(scenario) in packaged:
        return packaged[str(scenario)]
    path = beside.parent / scenario if beside else Path(scenario)
    if path.suffix == ".toml" and path.is_file():
        return path
    raise ConfigError(
        f"unknown scenario {str(scenario)!r}.",
        todo=f"Give one of {', '.join(packaged)}, or the path of a .toml file that exists.",
    )


def _read(path: Path, seen: tuple[Path, ...]) -> dict[str, dict[str, Any]]:
    """Read a TOML file over its base; unknown sections and keys are refused with their file."""
    if path in seen:
        raise ConfigError(f"scenarios start from each other: {' -> '.join(p.stem for p in (*seen, path))}.")
    try:
        own = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not valid TOML: {error}.", where=str(path), todo="Mend the file.") from None
    base = own.pop("base", None if path == packaged_scenarios()[ROOT_SCENARIO] else ROOT_SCENARIO)
    tree: dict[str, dict[str, Any]] = (
        _read(_find(base, beside=path), (*seen, path)) if base else {name: {} for name in SECTIONS}
    )
    for kind, keys in _kinds(own.pop(MIXED, {}), path).items():
        tree.setdefault(MIXED, {}).setdefault(kind, {}).update(keys)
    for section, keys in own.items():
        if section not in SECTIONS or not isinstance(keys, dict):
            raise ConfigError(
                f"unknown section or key {section!r}.",
                where=str(path),
                todo=f"Sections are {', '.join(SECTIONS)} and {MIXED}.NAME; keys stand inside them.",
            )
        for key, value in keys.items():
            _locate(f"{section}.{key}", where=str(path))
            tree[section][key] = value
    _fix_core(tree, own.get("aggregate", {}))
    return tree


def _fix_core(tree: dict[str, dict[str, Any]], given: Collection[str]) -> None:
    """Take a core rule that is given as it is: who asks for a number of samples means DBSCAN's, whatever the fleet."""
    if "min_samples" in given and "min_samples_share" not in given:
        tree["aggregate"]["min_samples_share"] = 0.0


def _kinds(kinds: Any, path: Path) -> dict[str, dict[str, Any]]:
    """Check the sensor kinds of a file."""
    if not isinstance(kinds, dict) or not all(isinstance(keys, dict) for keys in kinds.values()):
        raise ConfigError(f"[{MIXED}] holds keys.", where=str(path), todo=f"Give each kind a section [{MIXED}.NAME].")
    for kind, keys in kinds.items():
        for key in keys:
            _locate(f"{MIXED}.{kind}.{key}", where=str(path))
    return kinds


def _reach(tree: dict[str, Any], place: list[str]) -> dict[str, Any]:
    for part in place:
        tree = tree.setdefault(part, {})
    return tree


def _locate(key: str, where: str) -> tuple[str, ...]:
    """Return section and name of a key given with or without its section; `mixed`, kind and name of a kind's key."""
    section, _, name = key.rpartition(".")
    top, _, kind = section.partition(".")
    if top == MIXED and kind and (name == "share" or name in SensorConfig.model_fields):
        return MIXED, kind, name
    section = section or _SECTION_OF.get(name, "")
    if section in SECTIONS and name in SECTIONS[section].model_fields:
        return section, name
    near = difflib.get_close_matches(name, _SECTION_OF, n=3)
    hint = f"Did you mean {' or '.join(near)}?" if near else "`geofleet schema config` lists the keys."
    raise ConfigError(f"unknown scenario key {key!r}.", where=where, todo=hint)


def _split_override(text: str) -> tuple[str, Any]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"{text!r} is not key=value.", where="--set", todo="Example: --set eps_m=4.0")
    try:
        return key.strip(), tomllib.loads(f"v = {value}")["v"]
    except tomllib.TOMLDecodeError:
        return key.strip(), value.strip()  # a bare word: --set tracker=kalman


def _explained(error: ValidationError, path: Path, given: set[tuple[str, ...]]) -> ConfigError:
    """Return one error of all faults; a file is named unless every fault is a key that was given beside it."""
    faults: dict[str, str] = {}
    is_of_file = False
    for fault in error.errors():
        place = tuple(str(part) for part in fault["loc"])
        if place[:1] == (MIXED,):
            place = tuple(part for part in place if part != "sensor")
            if f"sensor.{place[-1]}" in faults and place not in given:
                continue  # it has that from [sensor]
        key = place[: 3 if place[:1] == (MIXED,) else 2]
        is_of_file |= key not in given and not (not key and any(MIXED in other for other in given))
        if place:
            got = "" if fault["type"] == "missing" else f" (got {fault['input']!r})"
            faults[".".join(place)] = f"{'.'.join(place)}: {fault['msg']}{got}"
        else:
            faults[""] = str(fault["ctx"]["error"])
    todo = "Correct the value in the file or the option." if is_of_file else "Correct the option."
    return ConfigError("; ".join(faults.values()) + ".", where=str(path) if is_of_file else "", todo=todo)
