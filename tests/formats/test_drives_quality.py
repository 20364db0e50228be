from __future__ import annotations

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from pyproj import Geod

from geofleet.algorithms.drive_quality import find_jumps, find_stops, hasty_fixes, unbacked_fixes
from geofleet.formats.drive_epochs import Epochs
from geofleet.formats.drive_quality import WRONG_FIXES, judge_epochs
from geofleet.formats.drives import read_drive
from geofleet.tables.store import lonlat

METRE = 1 / 111_320  # degrees of latitude


def epochs_of(t_s, north_m, east_m=None, **given):
    t_utc = np.datetime64("2024-05-01", "us") + (np.asarray(t_s) * 1e6).astype("timedelta64[us]")
    east = np.zeros(len(t_s)) if east_m is None else np.asarray(east_m)
    return Epochs.of(10 + east * METRE, np.asarray(north_m) * METRE, t_utc=t_utc, **given)


def plane(t_s, speed=12.0, noise_m=0.02, seed=0):
    rng = np.random.default_rng(seed)
    return np.column_stack((speed * t_s, 40 * np.sin(t_s / 10))) + rng.normal(0, noise_m, (len(t_s), 2))


@pytest.mark.parametrize("rate_hz", [1, 5, 10])
@pytest.mark.parametrize("run", [1, 2, 9, 45])
@pytest.mark.parametrize("off_m", [41.8, 300.0])
def test_wrong_fixes_alone_and_in_runs_are_jumps_and_nothing_else_is(rate_hz, run, off_m):
    t = np.arange(600) / rate_hz
    xy = plane(t)
    assert not find_jumps(t, xy).any()
    xy[200 : 200 + run] += [0.0, off_m]
    assert np.flatnonzero(find_jumps(t, xy)).tolist() == list(range(200, 200 + run))


def test_wrong_fixes_at_either_end_and_all_different_are_jumps():
    t = np.arange(300) / 5
    xy = plane(t)
    wrong = [0, 1, 70, 72, 73, 150, 298, 299]
    xy[wrong] += np.random.default_rng(1).uniform(50, 5000, (len(wrong), 2))
    assert np.flatnonzero(find_jumps(t, xy)).tolist() == wrong


def test_a_step_between_two_long_stretches_starts_a_segment_and_loses_neither():
    t = np.arange(2000) / 5
    xy = plane(t)
    xy[1000:] += [0.0, 60.0]
    assert not find_jumps(t, xy).any()
    judged = judge_epochs(epochs_of(t, xy[:, 0], xy[:, 1]))
    assert np.flatnonzero(np.diff(judged.motion.segment)).tolist() == [999]
    assert judged.found["impossible steps that start a segment"] == 1
    assert judged.found["gaps"] == 0


def test_hard_braking_and_a_hairpin_are_no_jumps():
    t = np.arange(0, 30, 0.2)
    speed = np.clip(20 - 9.5 * np.clip(t - 10, 0, None), 0, None)  # an emergency stop
    along = np.concatenate(([0], np.cumsum((speed[1:] + speed[:-1]) * 0.1)))
    assert not find_jumps(t, np.column_stack((along, 0 * t))).any()
    angle = 8 * t / 10  # 8 m/s on a radius of 10 m
    assert not find_jumps(t, 10 * np.column_stack((np.cos(angle), np.sin(angle)))).any()


def test_noise_of_a_phone_is_no_jump():
    t = np.arange(600.0)
    assert find_jumps(t, plane(t, noise_m=3.0)).sum() == 0


def test_of_garbage_something_is_left():
    t = np.arange(400) / 5
    jump = find_jumps(t, np.random.default_rng(2).uniform(0, 1e6, (400, 2)))
    assert 0 < (~jump).sum() <= 400


def test_a_stop_keeps_its_first_and_last_epoch_and_its_heading():
    t = np.arange(0, 60, 0.5)
    north = np.where(t < 20, 10 * t, np.where(t < 40, 200.0, 200 + 10 * (t - 40)))
    north = north + np.random.default_rng(3).normal(0, 0.01, len(t))
    judged = judge_epochs(epochs_of(t, north))
    kept = judged.epochs.seconds()
    assert judged.found["stops"] == 1
    assert judged.skipped["epochs inside of a stop"] == pytest.approx(39, abs=1)
    inside = (kept > 19.5) & (kept < 40.5)
    np.testing.assert_allclose(kept[inside], [20, 40], atol=0.5)
    assert judged.motion.speed_mps[inside].tolist() == [0.0, 0.0]
    assert np.abs((judged.motion.heading_deg + 180) % 360 - 180).max() < 1.0  # north throughout
    assert set(judged.motion.segment.tolist()) == {0}  # what is left out of a stop is no gap


def test_two_stops_apart_are_two_and_a_crawl_is_none():
    t = np.arange(0, 40.0)
    xy = np.column_stack((np.where(t < 10, 0, np.where(t < 20, 5 * (t - 10), 50)), 0 * t))
    stops = find_stops(t, xy, np.zeros(40, int))
    assert (stops.first.tolist(), stops.last.tolist()) == ([0, 20], [10, 39])
    assert len(find_stops(t, np.column_stack((0.5 * t, 0 * t)), np.zeros(40, int)).first) == 0


def test_duplicates_disorder_and_epochs_without_a_time_are_counted():
    t = np.array([0, 1, 2, 2, 4, 3, 5.0])
    epochs = epochs_of(t, 10 * t)
    t_utc = epochs.t_utc.copy()
    t_utc[6] = np.datetime64("NaT")
    judged = judge_epochs(replace(epochs, t_utc=t_utc))
    assert judged.epochs.seconds().tolist() == [0, 1, 2, 3, 4]
    assert judged.found["epochs out of order"] == 1
    assert {k: v for k, v in judged.skipped.items() if v} == {"duplicate epochs": 1, "epochs without a time": 1}


def test_places_without_times_keep_their_order_and_have_headings_but_no_speeds():
    epochs = Epochs.of(np.array([10, 10, 10.001]), np.array([50, 50.001, 50.001]), part=np.array([3, 3, 7]))
    judged = judge_epochs(epochs)
    assert judged.motion.segment.tolist() == [0, 0, 1]
    assert judged.motion.heading_deg[0] == pytest.approx(0, abs=1e-6)
    assert np.isnan(judged.motion.speed_mps).all()


def test_fixes_that_do_not_hold_are_hasty_and_short_recordings_are_not():
    t = np.arange(100) / 5
    fixed = np.zeros(100, bool)
    fixed[10:12], fixed[40:80] = True, True
    segment = np.zeros(100, int)
    assert np.flatnonzero(hasty_fixes(t, fixed, segment)).tolist() == [10, 11]
    assert not hasty_fixes(t[:5], np.ones(5, bool), segment[:5]).any()


def test_a_fix_of_few_satellites_that_does_not_hold_is_left_out_and_one_that_holds_is_kept():
    hasty = np.array([True, True, True, False])
    assert unbacked_fixes(hasty, np.array([4.0, 8.0, np.nan, 4.0])).tolist() == [True, False, False, False]
    t = np.arange(200) / 5
    quality = np.full(200, "float", object)
    quality[20:24], quality[60:140] = "fixed", "fixed"
    judged = judge_epochs(epochs_of(t, 12 * t, quality=quality, n_satellites=np.full(200, 5.0)))
    assert judged.skipped[WRONG_FIXES] == 4
    assert (judged.epochs.quality == "fixed").sum() == 80
    assert judged.found["seconds without a fix that holds, at the longest"] == 12


@pytest.fixture(scope="module")
def nagoya(shared_data):
    """Return a function from a table to the distances of its epochs from the surveyed drive, metres."""
    folder = shared_data / "trajectory" / "nagoya"
    truth = pd.read_csv(folder / "reference.csv", skipinitialspace=True)
    start = pd.Timestamp("1980-01-06", tz="UTC")
    week, tow = truth["GPS Week"], truth["GPS TOW (s)"]
    utc = (start + pd.to_timedelta(week * 604_800 + tow - 18, unit="s")).dt.as_unit("us").astype("int64").to_numpy()

    def error_m(table):
        at = table["t_utc"].cast("int64").to_numpy()
        lon, lat = lonlat(table)
        there = [np.interp(at, utc, truth[name], np.nan, np.nan) for name in ("Longitude (deg)", "Latitude (deg)")]
        return np.asarray(Geod(ellps="WGS84").inv(lon, lat, *there)[2])

    return error_m


def test_what_nagoya_calls_fixed_is_where_the_car_was(shared_data, nagoya):
    """The raw file has 113 fixed epochs more than 1 m off, up to 41.8 m; they come and go among float ones.

    The one of 41.8 m lies among float epochs that are as wrong, so that it is no jump: four satellites give it away.
    """
    layer = read_drive(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos")
    fixed = np.array(layer.table["fix_quality"].to_pylist()) == "fixed"
    error = nagoya(layer.table)
    assert np.nanmax(error[fixed]) < 0.2
    assert fixed.sum() > 500
    assert layer.found["fixes that do not hold, called float"] == 358
    assert layer.skipped[WRONG_FIXES] == 87
    left_out = np.datetime64("2023-07-11T06:18:13.800")  # the worst of them
    assert left_out not in layer.table["t_utc"].to_numpy()
    assert layer.skipped["impossible jumps"] == 137


def test_the_week_second_of_the_reference_is_its_time(shared_data, nagoya):
    layer = read_drive(shared_data / "trajectory" / "nagoya" / "reference.csv")
    assert np.nanmax(nagoya(layer.table)) < 1e-4
