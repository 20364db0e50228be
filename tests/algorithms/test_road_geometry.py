from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.special import fresnel

from geofleet.algorithms.road_geometry import (
    N_PARAMETERS,
    CubicProfile,
    PlanView,
    Shape,
    clothoid,
    reference_points,
    road_points,
    sample_stations,
)
from geofleet.errors import InputError


def plan(*records):
    """A plan view of records (shape, length, parameters, pose), each at the end of the one before by default."""
    starts, rows, x, y, heading = [], [], 0.0, 0.0, 0.0
    s = 0.0
    for shape, length, parameters, *pose in records:
        x, y, heading = pose[0] if pose else (x, y, heading)
        padded = [*parameters, *[0.0] * (N_PARAMETERS - len(parameters))]
        starts.append((s, x, y, heading, length, shape, padded))
        rows.append(one(*starts[-1][1:]))
        (x,), (y,), (heading,) = reference_points(rows[-1], [length])
        s += length
    columns = list(zip(*starts, strict=True))
    return PlanView(
        *(np.array(c, float) for c in columns[:5]), np.array(columns[5], np.int8), np.array(columns[6], float)
    )


def one(*record):
    *pose, shape, parameters = record
    numbers = (np.array([value], float) for value in (0.0, *pose))
    return PlanView(*numbers, np.array([shape], np.int8), np.array([parameters], float))


def integrated(curvature, rate, ds):
    """A clothoid by adaptive quadrature, an oracle without Fresnel integrals."""
    parts = (lambda tau, f=f: f(curvature * tau + rate * tau**2 / 2) for f in (np.cos, np.sin))
    return [quad(part, 0, ds, epsabs=1e-12, limit=400)[0] for part in parts]


def curve_length(view, end_m, n=20_001):
    """Length of the drawn line, refined by Richardson's rule (chords fall short in proportion to their square)."""
    lengths = []
    for step in (1, 2):
        x, y, _ = reference_points(view, np.linspace(0, end_m, n)[::step])
        lengths.append(np.hypot(np.diff(x), np.diff(y)).sum())
    return lengths[0] + (lengths[0] - lengths[1]) / 3


def test_straight_line():
    view = plan((Shape.LINE, 100, [], (10, 20, np.pi / 6)))
    x, y, heading = reference_points(view, [0, 40, 100])
    np.testing.assert_allclose(x, 10 + np.array([0, 40, 100]) * np.sqrt(3) / 2, atol=1e-12)
    np.testing.assert_allclose(y, [20, 40, 70], atol=1e-12)
    np.testing.assert_allclose(heading, np.pi / 6)


@pytest.mark.parametrize("radius", [50.0, -20.0, 1e7])
def test_arcs_stay_on_their_circle(radius):
    view = plan((Shape.ARC, 60, [1 / radius]))
    s = np.linspace(0, 60, 13)
    x, y, heading = reference_points(view, s)
    np.testing.assert_allclose(x, radius * np.sin(s / radius), atol=1e-8)
    np.testing.assert_allclose(y, 2 * radius * np.sin(s / radius / 2) ** 2, atol=1e-8)
    np.testing.assert_allclose(heading, s / radius, rtol=1e-12)


def test_an_arc_without_curvature_is_a_line():
    x, y, heading = reference_points(plan((Shape.ARC, 10, [0.0])), [4])
    assert (x[0], y[0], heading[0]) == (4, 0, 0)


def test_a_quarter_circle_to_the_right():
    x, y, heading = reference_points(plan((Shape.ARC, 5 * np.pi, [-0.1])), [5 * np.pi])
    np.testing.assert_allclose([x[0], y[0], heading[0]], [10, -10, -np.pi / 2], atol=1e-12)


def test_the_unit_clothoid_is_the_fresnel_integral():
    # Curvature πs from 0: x = C(s), y = S(s); C(1) and S(1) as tabulated (Abramowitz and Stegun, table 7.7)
    x, y, heading = reference_points(plan((Shape.SPIRAL, 1, [0, np.pi])), [0.5, 1])
    np.testing.assert_allclose([x[1], y[1]], [0.7798934004, 0.4382591474], atol=1e-10)
    np.testing.assert_allclose([x[0], y[0]], fresnel(0.5)[::-1], atol=1e-15)
    np.testing.assert_allclose(heading, [np.pi / 8, np.pi / 2])


@pytest.mark.parametrize(
    ("start", "end", "length"),
    [(0, 0.02, 80), (0.02, 0, 80), (-0.01, 0.03, 120), (-0.05, -0.01, 60), (0.01, 0.01 + 1e-9, 100), (0, 1e-13, 50)],
)
def test_clothoids_against_quadrature(start, end, length):
    rate = (end - start) / length
    for ds in (0.3 * length, length):
        u, v, turn = clothoid(start, rate, ds)
        np.testing.assert_allclose([u[0], v[0]], integrated(start, rate, ds), atol=2e-9)
        np.testing.assert_allclose(turn[0], start * ds + rate * ds**2 / 2, atol=1e-15)


@given(st.floats(-0.2, 0.2), st.floats(-12, -1), st.sampled_from([-1, 1]), st.floats(1, 100))
def test_clothoids_do_not_jump_where_the_method_changes(curvature, magnitude, sign, ds):
    rate = sign * 10.0**magnitude * max(abs(curvature), 1e-9)
    u, v, _ = clothoid(curvature, rate, ds)
    np.testing.assert_allclose([u[0], v[0]], integrated(curvature, rate, ds), atol=5e-9)


def test_poly3_counts_arc_length_and_not_u():
    # v = u²/20: s(u) = (u·√(1 + u²/100) + 10·asinh(u/10))/2, in closed form
    u = np.array([0.0, 3.0, 10.0, 25.0])
    s = (u * np.sqrt(1 + u**2 / 100) + 10 * np.arcsinh(u / 10)) / 2
    view = plan((Shape.POLY3, s[-1], [0, 0, 0.05, 0]))
    x, y, heading = reference_points(view, s)
    np.testing.assert_allclose(x, u, atol=1e-10)
    np.testing.assert_allclose(y, u**2 / 20, atol=1e-10)
    np.testing.assert_allclose(heading, np.arctan(u / 10), atol=1e-10)


def test_param_poly3_takes_ds_as_its_parameter():
    view = plan((Shape.PARAM_POLY3_ARC_LENGTH, 10, [1, 1, 0, -0.001, 2, 0, 0.01, 0], (5, 5, np.pi / 2)))
    x, y, heading = reference_points(view, [0, 10])
    np.testing.assert_allclose(x, [3, 2], atol=1e-12)  # 5 - v
    np.testing.assert_allclose(y, [6, 15], atol=1e-12)  # 5 + u
    np.testing.assert_allclose(heading, [np.pi / 2, np.pi / 2 + np.arctan2(0.2, 0.7)])


def test_normalized_param_poly3_ends_at_p_1_and_moves_evenly():
    # A Bézier curve with uneven speed, its length rounded to a centimetre as files have it
    view = plan((Shape.PARAM_POLY3_NORMALIZED, 33.17, [0, 60, -60, 30, 0, 0, 20, -10]))
    x, y, _ = reference_points(view, [0, 33.17])
    np.testing.assert_allclose([x[1], y[1]], [30, 10], atol=1e-9)
    x, y, _ = reference_points(view, np.linspace(0, 33.17, 5001))
    steps = np.hypot(np.diff(x), np.diff(y))
    assert steps.max() / steps.min() - 1 < 1e-4


cubics = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.003, 0.003), st.floats(-2e-5, 2e-5))


@settings(max_examples=25, deadline=None)
@given(st.data())
def test_s_is_arc_length_for_every_shape_that_promises_it(data):
    length = data.draw(st.floats(5, 60))
    shape = data.draw(st.sampled_from([Shape.LINE, Shape.ARC, Shape.SPIRAL, Shape.POLY3]))
    curvature = st.floats(-0.05, 0.05)
    parameters = {
        Shape.LINE: [],
        Shape.ARC: [data.draw(curvature)],
        Shape.SPIRAL: [data.draw(curvature), data.draw(curvature)],
        Shape.POLY3: [0.0, *data.draw(cubics)],
    }[shape]
    view = plan((shape, length, parameters))
    assert curve_length(view, length) == pytest.approx(length, abs=1e-6)
    # and the heading is the direction of the line
    s = np.linspace(0, length, 7)[1:-1]
    x, y, heading = reference_points(view, np.concatenate((s - 1e-4, s + 1e-4, s)))
    ahead = np.arctan2(y[5:10] - y[:5], x[5:10] - x[:5])
    np.testing.assert_allclose(np.exp(1j * ahead), np.exp(1j * heading[10:]), atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.floats(5, 60), cubics, st.floats(0.8, 1.2))
def test_normalized_cubics_divide_their_own_length_evenly(length, cubic, share):
    b, c, d = cubic
    scaled = [0, share * length, 0, 0, 0, b * length, c * length**2, d * length**3]
    view = plan((Shape.PARAM_POLY3_NORMALIZED, length, scaled))
    whole = curve_length(view, length)
    for part in (0.25, 0.5):
        assert curve_length(view, part * length) == pytest.approx(part * whole, rel=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(1, 80), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)), min_size=2, max_size=6))
def test_chained_records_join(pieces):
    shapes = (Shape.LINE, Shape.ARC, Shape.SPIRAL)
    view = plan(*((shapes[i % 3], length, [a, b][: i % 3]) for i, (length, a, b) in enumerate(pieces)))
    joints = view.s[1:]
    for before, after in zip(
        reference_points(view, np.nextafter(joints, 0)), reference_points(view, joints), strict=True
    ):
        np.testing.assert_allclose(before, after, atol=1e-9)
    assert view.end_m == pytest.approx(sum(length for length, *_ in pieces))


def test_points_beyond_the_ends_continue_the_nearest_record():
    x, y, _ = reference_points(plan((Shape.LINE, 10, []), (Shape.LINE, 10, [])), [-1, 21])
    np.testing.assert_allclose((x, y), ([-1, 21], [0, 0]))


def test_many_points_are_the_same_as_one_at_a_time():
    view = plan((Shape.POLY3, 30, [0, 0.1, 0.01, 0]), (Shape.SPIRAL, 30, [0, 0.1]), (Shape.ARC, 9, [0.1]))
    s = np.linspace(0, view.end_m, 20_000)
    many = np.array(reference_points(view, s))
    some = np.arange(0, 20_000, 997)
    single = np.array([np.concatenate(reference_points(view, [s[i]])) for i in some]).T
    np.testing.assert_allclose(many[:, some], single, atol=1e-11)


def test_profiles():
    profile = CubicProfile(np.array([10.0, 20.0]), np.array([[1, 0.5, 0.1, 0.01], [-3, 0, 0, 0]], float))
    np.testing.assert_allclose(profile.at([5, 10, 12, 20, 99]), [0, 1, 1 + 1 + 0.4 + 0.08, -3, -3])
    assert profile.at(12.0).shape == ()


def test_superelevation_tilts_the_cross_section():
    view = plan((Shape.LINE, 100, [], (0, 0, np.pi / 2)))  # northwards: left is west
    elevation = CubicProfile(np.array([0.0]), np.array([[100, 0.1, 0, 0]], float))
    tilt = CubicProfile(np.array([0.0]), np.array([[np.pi / 6, 0, 0, 0]]))
    points = road_points(view, [10, 10], [4, -4], elevation=elevation, superelevation=tilt)
    np.testing.assert_allclose(points.x, [-2 * np.sqrt(3), 2 * np.sqrt(3)])
    np.testing.assert_allclose(points.y, [10, 10])
    np.testing.assert_allclose(points.z, [103, 99])
    flat = road_points(view, [10], [4])
    np.testing.assert_allclose([flat.x[0], flat.z[0]], [-4, 0])


def test_stations():
    view = plan((Shape.LINE, 5, []), (Shape.LINE, 5, []))
    s = sample_stations(view, 1, 9, step_m=2, extra=[4.5, 20])
    np.testing.assert_allclose(s, [1, 2.75, 4.5, 5, 7, 9])


def test_what_cannot_give_a_place():
    empty = PlanView(*(np.empty(0) for _ in range(5)), np.empty(0, np.int8), np.empty((0, N_PARAMETERS)))
    with pytest.raises(InputError, match="no geometry"):
        reference_points(empty, [0.0])
    with pytest.raises(InputError, match="too large"):
        reference_points(one(0, 0, 0, 10, Shape.PARAM_POLY3_ARC_LENGTH, [1e308] * 8), [5.0])
