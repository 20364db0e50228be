"""The nearest road of each sign, against every road measured in an ENU frame of the sign's own."""

from __future__ import annotations

import numpy as np
import pytest

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.formats.osm_roads import MAX_ROAD_DISTANCE_M, RoadIndex, Roads


def roads_of(lines):
    points = np.concatenate(lines)
    return Roads(
        way_id=np.arange(len(lines)) + 100,
        part=np.zeros(len(lines), np.int64),
        oneway=np.zeros(len(lines), np.int8),
        kind=np.full(len(lines), "road", object),
        speed_limit_kmh=np.full(len(lines), np.nan),
        start=np.cumsum([0, *map(len, lines)]),
        lon=points[:, 0],
        lat=points[:, 1],
        n_missing_nodes=0,
    )


def distances_m(roads, lon, lat):
    """Return the distance of a point from every road."""
    first, run = roads.segments()
    frame = EnuFrame.around(np.array([lon]), np.array([lat]))
    start, end = (frame.to_enu(roads.lon[at], roads.lat[at]) for at in (first, first + 1))
    point = frame.to_enu(np.array([lon]), np.array([lat]))[0]
    along = end - start
    share = ((point - start) * along).sum(axis=1) / (along**2).sum(axis=1)
    distance = np.hypot(*(start + share.clip(0, 1)[:, np.newaxis] * along - point).T)
    nearest = np.full(len(roads.way_id), np.inf)
    np.minimum.at(nearest, run, distance)
    return nearest


@pytest.mark.parametrize("place", [(24.94, 60.17), (-70.0, -33.4), (0.0, 0.0), (103.8, 1.3), (15.6, 78.2)])
def test_the_nearest_road_is_the_one_measured_in_the_sign_s_own_frame(place):
    rng = np.random.default_rng(3)
    scale = np.array([1e-5 / np.cos(np.radians(place[1])), 1e-5])
    walks = (np.cumsum(rng.normal(0, 40, (n, 2)), axis=0) + rng.uniform(-600, 600, 2) for n in range(2, 62))
    lines = [place + walk * scale for walk in walks]
    lines.append(place + np.array([[-900.0, -200.0], [900.0, 200.0]]) * scale)  # one long segment
    roads = roads_of(lines)
    points = place + rng.uniform(-900, 900, (400, 2)) * scale
    near = RoadIndex(roads).nearest(points[:, 0], points[:, 1])
    assert 50 < (near.run >= 0).sum() < 400
    assert (np.isnan(near.bearing_deg) == (near.run < 0)).all()
    for run, (lon, lat) in zip(near.run, points, strict=True):
        distance_m = distances_m(roads, lon, lat)
        chosen_m = distance_m[run] if run >= 0 else MAX_ROAD_DISTANCE_M
        assert chosen_m == pytest.approx(min(distance_m.min(), MAX_ROAD_DISTANCE_M), abs=0.1)


def test_the_date_line_is_no_border():
    roads = roads_of([np.array([[179.9999, 10.0], [-179.9999, 10.0]])])
    near = RoadIndex(roads).nearest(np.array([179.99995, -179.99995]), np.array([10.0001, 10.0001]))
    assert near.run.tolist() == [0, 0]
    assert near.bearing_deg == pytest.approx([90.0, 90.0], abs=0.01)
    assert not near.is_right.any()


def test_without_roads_there_is_none():
    near = RoadIndex(roads_of([np.zeros((0, 2))])).nearest(np.array([10.0]), np.array([50.0]))
    assert near.run.tolist() == [-1]
