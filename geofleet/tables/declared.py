"""What a vehicle says about its own errors: right or not, it is all that the back end knows of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.information import PolarNoise

if TYPE_CHECKING:
    from geofleet.config import SensorConfig

LEAST_RANGE_SIGMA_M, LEAST_BEARING_SIGMA_DEG = 0.05, 0.05
"""No vehicle trusts a frame more than this, also where a study sets its noise to none."""


@dataclass(frozen=True, slots=True)
class Declared:
    """What a vehicle declares, in the columns of `passes`; what it tracks and sends information with is the same."""

    gnss_sigma_m: float
    range_bias_sigma_m: float
    bearing_bias_sigma_deg: float
    range_noise_sigma_m: float
    bearing_noise_sigma_deg: float
    false_negative_rate: float
    semantic_rate: float

    @classmethod
    def by(cls, sensor: SensorConfig, fleet: SensorConfig) -> Declared:
        """Return what a sensor declares: its own values or those of the fleet, sigmas times its scale.

        An error of the heading turns all bearings of a pass alike, so it is declared as bias.
        """
        said, scale = fleet if sensor.declares == "fleet" else sensor, sensor.declared_sigma_scale
        return cls(
            gnss_sigma_m=scale * said.gnss_sigma_m,
            range_bias_sigma_m=scale * said.range_bias_sigma_m,
            bearing_bias_sigma_deg=scale * float(np.hypot(said.bearing_bias_sigma_deg, said.heading_sigma_deg)),
            range_noise_sigma_m=max(scale * said.range_noise_sigma_m, LEAST_RANGE_SIGMA_M),
            bearing_noise_sigma_deg=max(scale * said.bearing_noise_sigma_deg, LEAST_BEARING_SIGMA_DEG),
            false_negative_rate=said.false_negative_rate,
            semantic_rate=said.semantic_rate,
        )

    @property
    def noise(self) -> PolarNoise:
        """The errors of the sensor, for the tracker and the information form."""
        return PolarNoise(
            self.range_noise_sigma_m,
            float(np.deg2rad(self.bearing_noise_sigma_deg)),
            self.range_bias_sigma_m,
            float(np.deg2rad(self.bearing_bias_sigma_deg)),
        )
