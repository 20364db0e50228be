"""The chain of sensing from true poses to frame detections, over all passes of a batch at once.

Passes are laid one after the other, as one long pass: what costs time runs over the rows of all of them, and only
random numbers are drawn pass by pass, from its own streams. A pass detects the same whichever passes are beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.confusion import read_classes
from geofleet.algorithms.occlusion import occluded
from geofleet.algorithms.sensing import (
    FIRST_BILLBOARD,
    FrameBiases,
    FrameDetections,
    PassSensing,
    Sightings,
    SignField,
    draw_calibration,
    drifting,
    ghost_frames,
    ghost_tracks,
    ghosts,
    in_view_of,
    keep_detected,
    measured,
    miss_rate,
    projected,
    recognised,
    reported_poses,
)
from geofleet.algorithms.sensing_kernels import by_frame
from geofleet.algorithms.streams import PassesRandom
from geofleet.algorithms.trajectory import Poses

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.billboards import Billboards
    from geofleet.algorithms.sensing import Calibration
    from geofleet.algorithms.sensor_model import SensorModel
    from geofleet.algorithms.streams import PassStreams

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]
    Reports = tuple[Sightings, Ints]  # with the class of each


@dataclass(frozen=True, slots=True)
class _Passes:
    """True poses, random numbers and calibration of each pass, and its frames, `start[k]:start[k + 1]`."""

    true: Sequence[Poses]
    streams: Sequence[PassStreams]
    calibrations: Sequence[Calibration]
    start: Ints

    def rows(self, frame: Ints) -> Ints:
        """Return the first row of each pass and, last, the number of all, of rows by frame."""
        return np.searchsorted(frame, self.start)

    def generators(self, name: str) -> list[Generator]:
        """Return one stream of every pass."""
        return [getattr(own, name) for own in self.streams]


def sense_pass(
    true: Poses, signs: SignField, model: SensorModel, streams: PassStreams, billboards: Billboards | None = None
) -> PassSensing:
    """Simulate what one pass over true poses detects, frame by frame: `sense_passes` of one."""
    return sense_passes([true], signs, model, [streams], billboards)


def sense_passes(
    true: Sequence[Poses],
    signs: SignField,
    model: SensorModel,
    streams: Sequence[PassStreams],
    billboards: Billboards | None = None,
) -> PassSensing:
    """Simulate what some passes over true poses detect, frame by frame; frames are numbered through all of them.

    Signs and billboards that are hidden are in view: they could have been seen, had nothing stood before them.
    """
    each = list(zip(true, streams, strict=True))
    visible = in_view_of(Poses.joined(true), signs, model)
    reported = Poses.joined(
        [reported_poses(one, model, own.pose, None if model.is_steady else own.drift) for one, own in each]
    )
    start = np.cumsum([0, *(len(one.heading_rad) for one in true)])
    passes = _Passes(true, streams, [_calibration(one, model, own) for one, own in each], start)
    seen = _signs_seen(visible, model, passes)
    class_code = _classes_seen(seen, signs, model, passes)
    for more in _more_seen(signs, model, passes, billboards):
        seen, class_code = _merged(seen, class_code, *more)
    xy_m, azimuth_rad = projected(seen, reported)
    detections = FrameDetections(
        *(seen.frame, seen.sign, class_code, xy_m, seen.range_m, azimuth_rad, int(start[-1]), start[1:-1])
    )
    return PassSensing(visible, detections, reported)


def _calibration(true: Poses, model: SensorModel, streams: PassStreams) -> Calibration:
    calibration = draw_calibration(model, streams.calibration)
    return drifting(calibration, true, model, streams.bias_drift) if model.has_bias_drift else calibration


def _signs_seen(visible: Sightings, model: SensorModel, passes: _Passes) -> Sightings:
    """Return what is measured of the signs in view that are neither missed nor hidden."""
    frames, row_start = passes.generators("frames"), passes.rows(visible.frame)
    kept = keep_detected(len(visible.frame), miss_rate(visible.range_m, model), PassesRandom(frames, row_start))
    if model.occluded_share > 0:
        number = np.repeat(np.arange(len(frames)), np.diff(row_start))
        kept &= ~occluded(
            visible.frame,
            visible.sign + number * (visible.sign.max(initial=0) + 1),  # hidden in one pass is not in the next
            share=model.occluded_share,
            mean_frames=model.occlusion_frames,
            rng=PassesRandom(passes.generators("occlusion"), row_start),
        )
    left = visible.take(np.flatnonzero(kept))
    biases = FrameBiases.of(passes.calibrations, passes.start)
    return measured(left, biases, model, PassesRandom(frames, passes.rows(left.frame)))


def _classes_seen(seen: Sightings, signs: SignField, model: SensorModel, passes: _Passes) -> Ints:
    """Return the reported class of each row, drawn once a sign and pass or for every frame."""
    row_start, n_passes, n_signs = passes.rows(seen.frame), len(passes.streams), len(signs.class_code)
    if model.semantic_draw == "frame":
        row, true_class, draw_start = np.arange(len(seen.sign)), signs.class_code[seen.sign], row_start
    else:
        row = seen.sign + np.repeat(n_signs * np.arange(n_passes), np.diff(row_start))
        true_class, draw_start = np.tile(signs.class_code, n_passes), n_signs * np.arange(n_passes + 1)
    rng = PassesRandom(passes.generators("classes"), draw_start)
    if model.confusion is None:
        drawn = recognised(true_class, n_classes=signs.n_classes, semantic_rate=model.semantic_rate, rng=rng)
    else:
        drawn = read_classes(true_class, model.confusion, rng)
    return drawn[row]


def _more_seen(
    signs: SignField, model: SensorModel, passes: _Passes, billboards: Billboards | None
) -> Iterator[Reports]:
    """Yield what is reported beside signs: billboards, ghosts that last, and ghosts of one frame."""
    each = list(zip(passes.true, passes.calibrations, passes.streams, strict=True))
    n_boards = 0 if billboards is None else len(billboards.share)
    if billboards is not None and n_boards:
        boards = [_billboards_seen(one, billboards, bias, model, own.billboards) for one, bias, own in each]
        yield _one_after_the_other(boards, passes)
    if model.ghost_tracks_per_km > 0:
        first = FIRST_BILLBOARD - n_boards
        lasting = [
            ghost_tracks(one, signs.n_classes, bias, model, own.ghost_tracks, first=first) for one, bias, own in each
        ]
        yield _one_after_the_other(lasting, passes)
    generators = passes.generators("ghosts")
    frame = ghost_frames(int(passes.start[-1]), model, PassesRandom(generators, passes.start))
    yield ghosts(frame, n_classes=signs.n_classes, model=model, rng=PassesRandom(generators, passes.rows(frame)))


def _one_after_the_other(reports: Sequence[Reports], passes: _Passes) -> Reports:
    seen = Sightings.joined([one for one, _ in reports], passes.start[:-1].tolist())
    return seen, np.concatenate([class_code for _, class_code in reports])


def _billboards_seen(
    true: Poses, billboards: Billboards, calibration: Calibration, model: SensorModel, rng: Generator
) -> Reports:
    """Return what is measured of the billboards that a pass takes for signs, and their classes."""
    taken = billboards.reported(rng)
    if not len(taken):
        return Sightings(taken, taken, np.empty(0), np.empty(0)), taken
    field = SignField(billboards.xy_m[taken], taken, n_classes=1, cell_m=model.range_m)
    visible = in_view_of(true, field, model)
    kept = keep_detected(len(visible.frame), miss_rate(visible.range_m, model), rng)
    if model.occluded_share > 0:
        share, mean_frames = model.occluded_share, model.occlusion_frames
        kept &= ~occluded(visible.frame, visible.sign, share=share, mean_frames=mean_frames, rng=rng)
    seen = measured(visible.take(kept), calibration, model, rng)
    number = taken[seen.sign]
    reported = Sightings(seen.frame, FIRST_BILLBOARD - number, seen.range_m, seen.bearing_rad)
    return reported, billboards.class_code[number]


def _merged(seen: Sightings, class_code: Ints, more: Sightings, more_class: Ints) -> Reports:
    """Return both together, by frame, the first of them first within a frame."""
    if not len(more_class):
        return seen, class_code
    order = by_frame(seen.frame, more.frame)
    both = Sightings.joined((seen, more), (0, 0))
    return both.take(order), np.concatenate((class_code, more_class))[order]
