"""A fleet ready to drive: its scene, the ways along its drives, and the kinds of sensors that its vehicles carry."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.billboards import Billboards, place_billboards
from geofleet.algorithms.confusion import confusion_matrix
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import world_stream
from geofleet.algorithms.tracking import TrackerModel
from geofleet.algorithms.trajectory import Poses, beside, frames_in_time, resample, travel_times, wander
from geofleet.errors import ConfigError, InputError
from geofleet.tables.declared import Declared
from geofleet.tables.scenes import Drive, Scene, load_drive, load_drives, pick_scene

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import pyarrow as pa
    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.geodesy import EnuFrame
    from geofleet.algorithms.streams import PassStreams
    from geofleet.algorithms.trajectory import DriveLine
    from geofleet.config import Config, FleetConfig, SensorConfig

    Floats = NDArray[np.float64]

MOST_GHOSTS_A_FRAME = 1000
FRAMES_TOGETHER = 6000
"""Frames of passes that are sensed together: enough to share the cost of a call, and they fit into the cache."""
_NOT_OF_THE_MODEL = {"sensor_kind", "confusion", "confusion_in_group", "declares", "declared_sigma_scale"}


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of sensor: the share of the vehicles up to and with it, its settings, what it declares, its models."""

    upto_share: float
    config: SensorConfig
    declared: Declared
    sensor: SensorModel
    tracker: TrackerModel


@dataclass(frozen=True, slots=True)
class Way:
    """A drive in one direction: its line, and frames at a constant distance along it."""

    drive: Drive
    line: DriveLine
    base: Poses


@dataclass(frozen=True, slots=True)
class Pass:
    """One vehicle's run: the way, the kind of its sensor, its true poses, and the time of every frame or NaT.

    `streams` are the random numbers of what follows.
    """

    vehicle: int
    streams: PassStreams
    way: Way
    kind: Kind
    true: Poses
    times: NDArray[np.datetime64]

    @property
    def frame_spacing_m(self) -> float:
        """Median distance between frames."""
        return float(np.median(np.diff(self.true.along_m)))


@dataclass(frozen=True, slots=True)
class Fleet:
    """Everything that the passes of all runs share."""

    config: Config
    scene: Scene
    ways: tuple[tuple[Way, ...], ...]  # by drive, then by direction
    kinds: tuple[Kind, ...]

    @property
    def frame(self) -> EnuFrame:
        """The frame of the scene and of all drives."""
        return self.ways[0][0].drive.frame

    @property
    def length_m(self) -> float:
        """Total length of the drives."""
        return float(sum(directions[0].line.along_m[-1] for directions in self.ways))

    def billboards(self, seed: int, replicate: int) -> Billboards | None:
        """Draw what all passes of a run may take for signs, when there is such a thing."""
        scene = self.config.scene
        if scene.billboards_per_km == 0:
            return None
        return place_billboards(
            tuple(directions[0].line for directions in self.ways),
            per_km=scene.billboards_per_km,
            share=scene.billboard_share,
            corridor_m=scene.corridor_m,
            n_classes=len(self.scene.classes),
            rng=world_stream(seed, replicate=replicate),
        )

    def start(self, vehicle: int, streams: PassStreams) -> Pass:
        """Draw the pass of a vehicle: sensor, drive, direction, the way through the lane and the speed."""
        has_choice = len(self.kinds) > 1 or len(self.ways) > 1 or len(self.ways[0]) > 1
        kind_u, drive_u, direction_u = streams.choice.random(3) if has_choice else (0.0, 0.0, 0.0)
        kind = next(kind for kind in self.kinds if kind_u < kind.upto_share)
        directions = self.ways[int(drive_u * len(self.ways))]
        way = directions[int(direction_u * len(directions))]
        fleet = self.config.fleet
        true = wander(
            way.base,
            sigma_m=fleet.lateral_sigma_m,
            correlation_m=fleet.lateral_correlation_m,
            spacing_m=fleet.frame_spacing_m,
            rng=streams.pose,
        )
        true = _timed(true, way.line, fleet, streams.pose)
        return Pass(vehicle, streams, way, kind, true, _frame_times(way.drive, true, vehicle * fleet.headway_s))


def together(passes: Iterable[Pass]) -> list[list[Pass]]:
    """Group passes that are sensed together: of one kind of sensor, and up to `FRAMES_TOGETHER` frames in all."""
    groups: list[list[Pass]] = []
    filling: dict[int, list[Pass]] = {}
    for one in passes:
        group = filling.get(id(one.kind), [])
        if not group or sum(len(other.times) for other in group) + len(one.times) > FRAMES_TOGETHER:
            group = filling[id(one.kind)] = []
            groups.append(group)
        group.append(one)
    return groups


def load_fleet(layer: pa.Table, driven: pa.Table, *, source: Path, drive: Path, config: Config) -> Fleet:
    """Prepare a fleet.

    Parameters
    ----------
    layer, driven
        A `signs` and a `drives` table.
    source, drive
        Where they came from, for messages.
    config
        The study.

    Raises
    ------
    ConfigError
        A group is unknown, the scene has one class and classes are to be confused, or signs are to be hidden more
        often than episodes of that length can.
    InputError
        The drives cannot be used, do not move or have no times that are asked for, or no sign is near them.
    """
    kinds = _sensor_kinds(config)
    drives = load_drives(driven, drive) if config.fleet.drives == "all" else (load_drive(driven, drive),)
    try:
        ways = tuple(_directions(road, config.fleet) for road in drives)
    except InputError as error:
        raise InputError(error.what, where=str(drive), todo=error.todo) from None
    scene = pick_scene(
        layer,
        drives,
        source=source,
        corridor_m=config.scene.corridor_m,
        groups=config.scene.groups,
        cell_m=max(sensor.range_m for _, sensor in kinds),
        respect_facing=config.scene.respect_facing,
    )
    for _, sensor in kinds:
        _check_classes(scene, sensor, source)
    return Fleet(config, scene, ways, tuple(_kind(upto, sensor, scene, config) for upto, sensor in kinds))


def _sensor_kinds(config: Config) -> list[tuple[float, SensorConfig]]:
    """Return every kind with the share of the vehicles up to and with it; `[sensor]` has what is left."""
    kinds, upto = [], 0.0
    for kind in config.mixed.values():
        upto += kind.share
        kinds.append((upto, kind.sensor))
    kinds.append((1.0, config.sensor))
    for _, sensor in kinds:
        share, frames = sensor.occluded_share, sensor.occlusion_frames
        if share / (1 - share) > frames:
            raise ConfigError(
                f"occluded_share = {share:g} needs episodes of {share / (1 - share):.3g} frames or more, and "
                f"occlusion_frames is {frames:g}.",
                todo="Set occlusion_frames higher.",
            )
        cone_ha = sensor.range_m**2 * np.deg2rad(sensor.fov_deg) / 2e4
        if sensor.ghost_rate_per_ha * cone_ha > MOST_GHOSTS_A_FRAME:
            raise ConfigError(
                f"ghost_rate_per_ha = {sensor.ghost_rate_per_ha:g} over a view cone of {cone_ha:.3g} ha makes "
                f"{sensor.ghost_rate_per_ha * cone_ha:.3g} ghosts a frame, more than {MOST_GHOSTS_A_FRAME}.",
                todo="Set ghost_rate_per_ha lower: the paper's 2 % is 0.02.",
            )
    return kinds


def _check_classes(scene: Scene, sensor: SensorConfig, source: Path) -> None:
    if len(scene.classes) == 1 and sensor.semantic_rate < 1:
        raise ConfigError(
            f"semantic_rate = {sensor.semantic_rate:g} confuses classes, but the scene has only one: "
            f"{scene.classes[0]}.",
            where=str(source),
            todo="Set semantic_rate to 1, or widen corridor_m or groups.",
        )


def _kind(upto_share: float, config: SensorConfig, scene: Scene, study: Config) -> Kind:
    confusion = None
    if config.confusion == "group":
        confusion = confusion_matrix(
            scene.groups.tolist(), semantic_rate=config.semantic_rate, in_group=config.confusion_in_group
        )
    values = config.model_dump(exclude=_NOT_OF_THE_MODEL)
    sensor = SensorModel(**values, confusion=confusion)
    declared = Declared.by(config, study.sensor)
    tracker = TrackerModel(
        **study.tracking.model_dump() | {"send_information": study.tracking.sends_information},
        range_m=sensor.range_m,
        half_fov_rad=sensor.half_fov_rad,
        noise=declared.noise,
    )
    return Kind(upto_share, config, declared, sensor, tracker)


def _directions(drive: Drive, fleet: FleetConfig) -> tuple[Way, ...]:
    """Return the drive in the directions that it is driven in."""
    travel_times(drive.line, speed_mps=fleet.speed_mps, recorded=fleet.speed_profile == "recorded")  # or say why not
    lines = {"forward": drive.line, "backward": drive.line.backward()}
    wanted = ("forward", "backward") if fleet.direction == "both" else (fleet.direction,)
    ways = []
    for name in wanted:
        base = resample(lines[name], spacing_m=fleet.frame_spacing_m, heading_baseline_m=fleet.heading_baseline_m)
        if name == "backward":
            base = beside(base, -fleet.opposite_lane_m)  # left of the drive is right of one who comes back
        ways.append(Way(drive, lines[name], base))
    return tuple(ways)


def _timed(true: Poses, line: DriveLine, fleet: FleetConfig, rng: Generator) -> Poses:
    """Draw the speed of a pass and return its poses with their times, at a constant frame rate when there is one."""
    factor = np.exp(fleet.speed_factor_sigma * rng.standard_normal())
    if fleet.speed_profile == "constant" and not fleet.frame_rate_hz:
        return Poses(true.xy_m, true.heading_rad, true.along_m, true.along_m / (fleet.speed_mps * factor))
    times_s = travel_times(line, speed_mps=fleet.speed_mps, recorded=fleet.speed_profile == "recorded") / factor
    if not fleet.frame_rate_hz:
        return Poses(true.xy_m, true.heading_rad, true.along_m, np.interp(true.along_m, line.along_m, times_s))
    return frames_in_time(true, line, times_s=times_s, rate_hz=fleet.frame_rate_hz)


def _frame_times(drive: Drive, true: Poses, begin_s: float) -> NDArray[np.datetime64]:
    """Return the time of every frame; without a dated drive there is none, NaT."""
    if drive.t_start is None or true.elapsed_s is None:
        return np.full(len(true.heading_rad), np.datetime64("NaT", "us"))
    microseconds = np.rint((begin_s + true.elapsed_s) * 1e6).astype("timedelta64[us]")
    times: NDArray[np.datetime64] = drive.t_start + microseconds
    return times
