"""What a camera sees and how wrong it is, in one set of numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SensorModel:
    """What a sensor sees and how wrong it is; every sigma is that of a zero-mean normal distribution.

    Parameters
    ----------
    range_m, fov_deg
        The view cone: distance below `range_m` and |bearing| below half of the full angle `fov_deg`.
    gnss_sigma_m
        Offset of the reported position, a axis and pass.
    heading_sigma_deg
        Offset of the reported heading, a pass.
    range_bias_sigma_m, bearing_bias_sigma_deg
        Sensor-setting error, once a sensor.
    range_noise_sigma_m, bearing_noise_sigma_deg
        Measurement noise, once a frame and object.
    false_negative_rate
        Probability that a sign in view is missed, a frame.
    semantic_rate
        Probability that a class is recognised.
    semantic_draw
        Recognition is drawn once a sign and pass (`track`), or anew for every frame (`frame`).
    ghost_rate_per_ha
        Expected false positives a frame and hectare of the view cone.
    gnss_drift_sigma_m, gnss_drift_correlation_s
        Drift of the reported position beside the offset, an axis (`pose_errors.gauss_markov`).
    wrong_fixes_per_km, wrong_fix_length_m, wrong_fix_sigma_m
        Episodes of a wrong fix (`pose_errors.wrong_fixes`).
    fade_range_m, fade_width_m
        Distance at which detection has fallen to half, and scale of the fall; 0 = it does not fall.
    range_bias_m, bearing_bias_deg
        A fault of the calibration: what the sensor adds beside the error that is drawn, alike for all.
    range_bias_drift_sigma_m, bearing_bias_drift_sigma_deg, bias_drift_correlation_s
        Drift of the sensor-setting error over a pass (`pose_errors.gauss_markov`).
    ghost_tracks_per_km, ghost_track_frames
        False positives that stay at their place for several frames in a row, this many on average.
    occluded_share, occlusion_frames
        Share of frames in which a sign in view is hidden, and for how many in a row on average (`occlusion.occluded`).
    confusion
        P(read class | true class), shape (n, n), instead of `semantic_rate` and any other class alike.
    """

    range_m: float
    fov_deg: float
    gnss_sigma_m: float = 0.0
    heading_sigma_deg: float = 0.0
    range_bias_sigma_m: float = 0.0
    bearing_bias_sigma_deg: float = 0.0
    range_noise_sigma_m: float = 0.0
    bearing_noise_sigma_deg: float = 0.0
    false_negative_rate: float = 0.0
    semantic_rate: float = 1.0
    semantic_draw: Literal["track", "frame"] = "track"
    ghost_rate_per_ha: float = 0.0
    gnss_drift_sigma_m: float = 0.0
    gnss_drift_correlation_s: float = 60.0
    wrong_fixes_per_km: float = 0.0
    wrong_fix_length_m: float = 50.0
    wrong_fix_sigma_m: float = 10.0
    fade_range_m: float = 0.0
    fade_width_m: float = 10.0
    occluded_share: float = 0.0
    occlusion_frames: float = 5.0
    range_bias_m: float = 0.0
    bearing_bias_deg: float = 0.0
    range_bias_drift_sigma_m: float = 0.0
    bearing_bias_drift_sigma_deg: float = 0.0
    bias_drift_correlation_s: float = 60.0
    ghost_tracks_per_km: float = 0.0
    ghost_track_frames: float = 8.0
    confusion: Floats | None = None

    @property
    def half_fov_rad(self) -> float:
        """Half of the opening angle of the view cone."""
        return float(np.deg2rad(self.fov_deg)) / 2

    @property
    def cone_area_m2(self) -> float:
        """Area of the view cone, ½ r² FOV (paper, "False Positives and False Negatives")."""
        return self.range_m**2 * self.half_fov_rad

    @property
    def ghosts_per_frame(self) -> float:
        """λ = FP_rate · A (paper, ibid.), with the rate a hectare."""
        return self.ghost_rate_per_ha * self.cone_area_m2 / 1e4

    @property
    def is_steady(self) -> bool:
        """The reported position is off by the same all the way."""
        return self.gnss_drift_sigma_m == self.wrong_fixes_per_km == 0

    @property
    def has_bias_drift(self) -> bool:
        """The sensor-setting error changes over a pass."""
        return self.range_bias_drift_sigma_m > 0 or self.bearing_bias_drift_sigma_deg > 0
