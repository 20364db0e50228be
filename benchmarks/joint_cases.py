"""What the benchmark of joint fusion holds against it: faults of a prior map, and fleets that are not as they say."""

from __future__ import annotations

from joint_fleets import Case

from geofleet.algorithms.staleness import Staleness

SIGMA_M = 0.15
PRIOR_CASES = {
    "up to date": Staleness(sigma_m=SIGMA_M),
    "15 % removed": Staleness(removed=0.15, sigma_m=SIGMA_M),
    "10 % retyped": Staleness(retyped=0.1, sigma_m=SIGMA_M),
    "10 % moved 5 m": Staleness(moved=0.1, moved_m=5.0, sigma_m=SIGMA_M),
    "10 % obsolete": Staleness(obsolete=0.1, sigma_m=SIGMA_M),
    "all together": Staleness(0.15, 0.1, 0.1, 0.1, 5.0, SIGMA_M),
    "shifted by 1 m": Staleness(sigma_m=SIGMA_M, shift_m=(0.6, 0.8)),
    "all, shifted by 1 m": Staleness(0.15, 0.1, 0.1, 0.1, 5.0, SIGMA_M, (0.6, 0.8)),
}

N_VEHICLES, BATCH = 20, 5


def _case(signs: str = "real", **settings: object) -> Case:
    keys = {name.replace("__", "."): value for name, value in settings.items()}
    return Case(settings={"tracker": "kalman", **keys}, n_vehicles=N_VEHICLES, signs=signs, batch=BATCH)


ROBUSTNESS = {
    "as declared": _case(),
    "sigmas declared twice too large": _case(declared_sigma_scale=2.0),
    "sigmas declared twice too small": _case(declared_sigma_scale=0.5),
    "misses 25 % of frames": _case(false_negative_rate=0.25),
    "misses 60 % of frames": _case(false_negative_rate=0.6),
    "hidden half of the time": _case(occluded_share=0.5, occlusion_frames=20.0),
    "class read right 80 % of frames": _case(semantic_rate=0.8),
    "class read right for 80 % of tracks": _case(semantic_rate=0.8, semantic_draw="track"),
    "ten times the clutter": _case(ghost_rate_per_ha=0.2),
    "ghosts that last, 5 a km and pass": _case(ghost_tracks_per_km=5.0),
    "persistent ghosts, 5 a km": _case(billboards_per_km=5.0),
    "half of the tracks split": _case(split_track_rate=0.5),
    "one car in ten with a fault of 10 m, 5°": _case(
        mixed__faulty__share=0.1, mixed__faulty__range_bias_m=10.0, mixed__faulty__bearing_bias_deg=5.0
    ),
    "one car in ten off by 10 m where 1.3 m are declared": _case(
        mixed__faulty__share=0.1, mixed__faulty__declares="fleet", mixed__faulty__gnss_sigma_m=10.0
    ),
    "half of the fleet three times worse than declared": _case(
        mixed__worse__share=0.5,
        mixed__worse__declares="fleet",
        mixed__worse__gnss_sigma_m=3.9,
        mixed__worse__range_bias_sigma_m=8.7,
        mixed__worse__bearing_bias_sigma_deg=11.1,
        mixed__worse__range_noise_sigma_m=4.2,
        mixed__worse__bearing_noise_sigma_deg=2.1,
    ),
    "biases that drift over a minute": _case(
        range_bias_drift_sigma_m=1.0, bearing_bias_drift_sigma_deg=0.5, gnss_drift_sigma_m=0.5
    ),
    "means only": _case(send_information=False),
    "signs every 9 m": _case("regular"),
    "one RTK car in twenty": _case(mixed__rtk__share=0.05, mixed__rtk__gnss_sigma_m=0.05),
}
