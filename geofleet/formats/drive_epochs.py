"""The epochs of a drive as every reader of trajectories hands them over."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.tables.arrays import FIRST_TIME, LAST_TIME

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MAX_LAT_DEG, MAX_LON_DEG = 90.0, 180.0
NO_POSITION = "epochs without a valid position"
NO_EPOCH = "lines that are no epoch"


@dataclass(frozen=True, slots=True)
class Epochs:
    """Epochs in the order of their file, all of shape (n,); what the file does not say is NaT, NaN or None.

    Parameters
    ----------
    t_utc
        UTC in microseconds.
    lon, lat
        Degrees.
    height_m
        Above the ellipsoid.
    quality
        Name of the fix quality.
    sigma_e_m, sigma_n_m
        Standard deviations as declared.
    n_satellites
        Satellites used.
    elapsed_s
        Seconds since some moment, for a file that does not say which; else None.
    part
        Number of the stretch that the file itself sets apart, such as a track segment; None without any.
    has_clock
        The seconds were measured: a long one between two epochs is a gap, and a short one can make a step impossible.
    """

    t_utc: NDArray[np.datetime64]
    lon: Floats
    lat: Floats
    height_m: Floats
    quality: NDArray[np.object_]
    sigma_e_m: Floats
    sigma_n_m: Floats
    n_satellites: Floats
    elapsed_s: Floats | None = None
    part: Ints | None = None
    has_clock: bool = True

    @classmethod
    def of(cls, lon: Floats, lat: Floats, **given: Any) -> Epochs:
        """Return epochs of which nothing is known but the position and what is given.

        A year like -1 or 40000, as a damaged line may have it, is no time.
        """
        n = len(lon)
        unknown = {name: np.full(n, np.nan) for name in ("height_m", "sigma_e_m", "sigma_n_m", "n_satellites")}
        empty = {"t_utc": np.full(n, "NaT", "datetime64[us]"), "quality": np.full(n, None, object)}
        values = unknown | empty | given
        sound = (values["t_utc"] >= FIRST_TIME) & (values["t_utc"] < LAST_TIME)
        return cls(
            lon=lon, lat=lat, **(values | {"t_utc": np.where(sound, values["t_utc"], np.datetime64("NaT", "us"))})
        )

    def take(self, rows: NDArray[np.bool_] | Ints) -> Epochs:
        """Return some of the epochs."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        some: dict[str, Any] = {name: v[rows] for name, v in values.items() if isinstance(v, np.ndarray)}
        return replace(self, **some)

    def seconds(self) -> Floats:
        """Return seconds since the first epoch with a time; NaN where an epoch has none."""
        if self.elapsed_s is not None:
            return self.elapsed_s
        known = self.t_utc[~np.isnat(self.t_utc)]
        if not len(known):
            return np.full(len(self.t_utc), np.nan)
        return np.asarray((self.t_utc - known[0]) / np.timedelta64(1, "s"), np.float64)

    def is_placed(self) -> NDArray[np.bool_]:
        """Tell which epochs have a position on the Earth; 0 N 0 E is what receivers write without one."""
        finite = np.isfinite(self.lon) & np.isfinite(self.lat)
        inside = finite & (np.abs(self.lat) <= MAX_LAT_DEG) & (np.abs(self.lon) <= MAX_LON_DEG)
        return np.asarray(inside & ((self.lat != 0.0) | (self.lon != 0.0)))
