"""The bias of each pass taken out before clustering: against the same algebra in numpy, and against known biases."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.information import bias_posterior
from geofleet.config import load_config
from geofleet.errors import InputError
from geofleet.steps.aggregate import aggregate
from geofleet.tables.database import connect
from geofleet.tables.schemas import DETECTIONS, PASSES, SIGNS
from geofleet.tables.staging import stage_detections
from geofleet.tables.store import build_table, lonlat, read_table, write_table

UPPER = np.triu_indices(4)
SIGMA_RANGE_M, SIGMA_BEARING_RAD = 0.3, np.radians(0.2)
BIAS_SIGMA = (2.0, np.radians(2.0))


def see(frame, signs_xy, n_passes, *, noise=1.0, seed=0, declared=1.0):
    """Return detections in information form of straight passes along x, and the bias of each pass."""
    rng = np.random.default_rng(seed)
    biases = rng.normal(0, 1, (n_passes, 2)) * BIAS_SIGMA
    rows = {
        name: [] for name in ("pass_id", "track_id", "info_matrix", "info_vector", "info_s0", "info_dof", "n_frames")
    }
    places, origins = [], []
    for p, bias in enumerate(biases):
        for t, sign in enumerate(signs_xy):
            poses = np.column_stack((sign[0] - np.arange(10.0, 60.0, 5.0), rng.uniform(-1, 1, 10)))
            to_sign = sign - poses
            d, a = np.hypot(*to_sign.T), np.arctan2(to_sign[:, 1], to_sign[:, 0])
            z = np.column_stack((d + bias[0], a + bias[1]))
            z += noise * rng.normal(0, 1, z.shape) * (SIGMA_RANGE_M, SIGMA_BEARING_RAD)
            places.append((poses + (z[:, :1] * np.column_stack((np.cos(z[:, 1]), np.sin(z[:, 1]))))).mean(axis=0))
            origin = sign + rng.normal(0, 0.05, 2)
            e = origin - poses
            r = np.hypot(*e.T)
            jacobian = np.zeros((2 * len(poses), 4))
            jacobian[::2, :2], jacobian[::2, 2] = e / r[:, None], 1
            jacobian[1::2, :2], jacobian[1::2, 3] = np.column_stack((-e[:, 1], e[:, 0])) / r[:, None] ** 2, 1
            residual = (z - np.column_stack((r, np.arctan2(e[:, 1], e[:, 0])))).ravel()
            weight = np.tile([SIGMA_RANGE_M**-2, SIGMA_BEARING_RAD**-2], len(poses)) * declared
            matrix = jacobian.T @ (weight[:, None] * jacobian)
            vector = jacobian.T @ (weight * residual)
            fit = np.linalg.lstsq(np.sqrt(weight)[:, None] * jacobian, np.sqrt(weight) * residual, rcond=None)[0]
            for name, value in (
                ("pass_id", f"p{p}"),
                ("track_id", t),
                ("info_matrix", matrix[UPPER].tolist()),
                ("info_vector", vector.tolist()),
                ("info_s0", float((weight * (residual - jacobian @ fit) ** 2).sum())),
                ("info_dof", 2.0 * len(poses) - 4),
                ("n_frames", len(poses)),
            ):
                rows[name].append(value)
            origins.append(origin)
    lon, lat = frame.to_lonlat(np.array(origins))
    columns = rows | {
        "run_id": "r",
        "vehicle_id": rows["pass_id"],
        "sign_class": "stop",
        "sigma_e_m": 0.5,
        "sigma_n_m": 0.5,
        "info_lon": lon,
        "info_lat": lat,
        "info_matrix": pa.array(rows["info_matrix"], pa.list_(pa.float64(), 10)),
        "info_vector": pa.array(rows["info_vector"], pa.list_(pa.float64(), 4)),
    }
    return build_table(DETECTIONS, columns, geometry=frame.to_lonlat(np.array(places))), biases


def place(tmp_path, table, passes=None):
    """Return the biases and the corrected detections of the staging, sorted by key."""
    write_table(DETECTIONS, table, tmp_path / "d.parquet")
    connection = connect()
    folder = tmp_path / "staged"
    folder.mkdir(exist_ok=True)
    staged = stage_detections(
        *(connection, tmp_path / "d.parquet", folder),
        zoom=16,
        halo_m=8.0,
        batch_rows=1000,
        n_vehicles=0,
        passes=passes,
        correct_bias=True,
    )
    biases = connection.table("biases").to_arrow_table()
    placed = connection.table("placed").order("pass_id, track_id").to_arrow_table()
    connection.close()
    return biases, placed, staged


def in_numpy(table, frame, prior_sigma):
    """Return positions in the frame, variances and biases by the formulas of the estimator, pass by pass."""
    origin = frame.to_enu(table["info_lon"].to_numpy(), table["info_lat"].to_numpy())
    matrices = np.zeros((table.num_rows, 4, 4))
    matrices[:, *UPPER] = np.array(table["info_matrix"].to_pylist())
    matrices = matrices + np.triu(matrices, 1).swapaxes(1, 2)
    vectors = np.array(table["info_vector"].to_pylist())
    names = np.array(table["pass_id"].to_pylist())
    xy, var, biases = np.empty((table.num_rows, 2)), np.empty(table.num_rows), []
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        schur, right = np.zeros((2, 2)), np.zeros(2)
        for i in rows:
            n, r = matrices[i], vectors[i]
            inverse = np.linalg.inv(n[:2, :2])
            schur = schur + n[2:, 2:] - n[2:, :2] @ inverse @ n[:2, 2:]
            right = right + r[2:] - n[2:, :2] @ inverse @ r[:2]
        bias, cov = bias_posterior(schur, right, np.array(prior_sigma))
        biases.append([*bias, cov[0, 0], cov[0, 1], cov[1, 1]])
        assert cov @ (np.diag(1 / np.square(prior_sigma)) + schur) == pytest.approx(np.eye(2), abs=1e-9)
        for i in rows:
            inverse = np.linalg.inv(matrices[i, :2, :2])
            gain = inverse @ matrices[i, :2, 2:]
            xy[i] = origin[i] + inverse @ (vectors[i, :2] - matrices[i, :2, 2:] @ bias)
            var[i] = np.trace(inverse + gain @ cov @ gain.T) / 2
    return xy, var, np.array(biases)


SIGNS_XY = np.array([(0.0, 5.0), (40.0, -6.0), (90.0, 4.0), (150.0, 5.0)])


@pytest.mark.parametrize(
    "place_deg", [(24.945, 60.168), (179.9999, 61.0), (-179.9999, 70.0), (10.0, 0.0), (151.2, -33.9)]
)
def test_positions_and_variances_are_those_of_the_formulas(tmp_path, place_deg):
    frame = EnuFrame(*place_deg)
    table, _ = see(frame, SIGNS_XY, 6, noise=0.0)  # the residual is 0: no track is left out, nothing is scaled
    biases, placed, staged = place(tmp_path, table)
    table = table.sort_by([("pass_id", "ascending"), ("track_id", "ascending")])
    xy, var, expected = in_numpy(table, frame, (5.0, np.radians(5.0)))
    # the statement and the function that a vehicle and joint fusion use say the same
    for column, name in enumerate(("range_bias_m", "bearing_bias_rad", "var_rr", "cov_rt", "var_tt")):
        assert biases[name].to_numpy() == pytest.approx(expected[:, column], rel=1e-6, abs=1e-12)
    assert np.abs(frame.to_enu(placed["lon"].to_numpy(), placed["lat"].to_numpy()) - xy).max() < 1e-4
    assert placed["var_m2"].to_numpy() == pytest.approx(var, rel=1e-6)
    assert np.abs(placed["lon"].to_numpy()).max() <= 180
    assert (staged.bias.n_passes, staged.bias.n_unsolved, staged.bias.n_uncorrected) == (6, 0, 0)
    assert biases["n_tracks"].to_pylist() == [4] * 6


def test_known_biases_are_found_and_their_uncertainty_is_told(tmp_path):
    table, truth = see(EnuFrame(24.9, 60.2), SIGNS_XY, 60, seed=4)
    biases, _, _ = place(tmp_path, table)
    order = [int(name[1:]) for name in biases["pass_id"].to_pylist()]
    error = np.column_stack((biases["range_bias_m"], biases["bearing_bias_rad"])) - truth[order]
    cov = np.stack([biases[name].to_numpy() for name in ("var_rr", "cov_rt", "cov_rt", "var_tt")], axis=1)
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov.reshape(-1, 2, 2)), error)
    assert 1.2 < chi2.mean() < 3.0  # two degrees of freedom
    range_rms_m, bearing_rms_rad = np.sqrt(np.mean(np.square(error), axis=0))
    assert range_rms_m < 0.2
    assert bearing_rms_rad < np.radians(0.2)


def test_noise_that_is_declared_too_small_is_scaled_up_and_still_solved(tmp_path):
    right, _ = see(EnuFrame(24.9, 60.2), SIGNS_XY, 5, seed=2)
    wrong, _ = see(EnuFrame(24.9, 60.2), SIGNS_XY, 5, seed=2, declared=100.0)  # sigmas a tenth of the true ones
    (good, _, _), (bad, _, _) = place(tmp_path, right), place(tmp_path, wrong)
    assert np.median(bad["scale"]) == pytest.approx(100, rel=0.5)
    assert bad["n_tracks"].to_pylist() == [4] * 5
    assert bad["range_bias_m"].to_numpy() == pytest.approx(good["range_bias_m"].to_numpy(), abs=0.05)


def passes_declaring(n_passes, **sigmas):
    line = [[(24.9, 60.2), (24.91, 60.2)]] * n_passes
    names = [f"p{k}" for k in range(n_passes)]
    columns = {
        **dict.fromkeys(("pass_id", "vehicle_id", "sensor_id"), names),
        "run_id": "r",
        "sensor_kind": "camera",
        "drive_id": "d",
        "range_m": 100.0,
        "fov_deg": 60.0,
        "frame_spacing_m": 2.0,
    }
    return build_table(PASSES, columns | sigmas, geometry=shapely.linestrings(line))


def test_what_a_car_declares_is_its_prior(tmp_path):
    table, truth = see(EnuFrame(24.9, 60.2), SIGNS_XY, 3, noise=0.0)
    write_table(PASSES, passes_declaring(3, range_bias_sigma_m=0.0, bearing_bias_sigma_deg=4.0), tmp_path / "p.parquet")
    biases, _, _ = place(tmp_path, table, passes=tmp_path / "p.parquet")
    assert np.abs(biases["range_bias_m"].to_numpy()).max() < 1e-6  # known to be none
    assert np.abs(biases["bearing_bias_rad"].to_numpy() - truth[:, 1]).max() < 0.05


def run_on(tmp_path, table, name="f", **options):
    write_table(DETECTIONS, table, tmp_path / f"{name}_d.parquet")
    config = load_config(overrides={"correct_bias": True, "min_support_share": 0.0} | options)
    return aggregate(tmp_path / f"{name}_d.parquet", tmp_path / f"{name}.parquet", config=config, n_workers=1)


def test_a_layer_is_nearer_to_the_truth_and_says_what_was_taken_out(tmp_path):
    frame = EnuFrame(24.9, 60.2)
    table, _ = see(frame, SIGNS_XY, 12, seed=1)
    errors = {}
    for correct in (False, True):
        result = run_on(tmp_path, table, correct_bias=correct)
        fused = read_table(SIGNS, result.out)
        xy = frame.to_enu(*lonlat(fused))
        errors[correct] = np.sqrt(np.mean([np.min(((xy - s) ** 2).sum(axis=1)) for s in SIGNS_XY]))
    assert errors[True] < 0.1 < errors[False]
    assert set(fused["method"].to_pylist()) == {"dbscan-peaks-corrected"}
    assert any("bias of 12 passes is taken out" in note for note in result.notes)


def test_row_order_does_not_show(tmp_path):
    table, _ = see(EnuFrame(24.9, 60.2), SIGNS_XY, 12, seed=1)
    mixed = table.take(np.random.default_rng(0).permutation(table.num_rows))
    one, other = run_on(tmp_path, table, "one"), run_on(tmp_path, mixed, "other", tile_zoom=20)
    assert one.out.read_bytes() == other.out.read_bytes()


def test_detections_without_the_form_stay_and_are_counted(tmp_path):
    table, _ = see(EnuFrame(24.9, 60.2), SIGNS_XY, 12, seed=1)
    blank = table.slice(0, 5).set_column(
        table.schema.get_field_index("info_matrix"), "info_matrix", pa.nulls(5, pa.list_(pa.float64(), 10))
    )
    _, placed, staged = place(tmp_path, pa.concat_tables([blank, table.slice(5)]))
    assert staged.bias.n_uncorrected == 5
    assert any("5 detections carry no usable information form" in note for note in staged.bias.notes())
    assert np.isfinite(placed["lon"].to_numpy()).all()


def test_a_fleet_without_the_form_is_told_what_to_do(tmp_path):
    table, _ = see(EnuFrame(24.9, 60.2), SIGNS_XY, 3)
    plain = table.drop_columns([name for name in table.column_names if name.startswith("info_")])
    with pytest.raises(InputError, match="none of 12 detections carries a usable information form"):
        run_on(tmp_path, plain)
    assert not (tmp_path / "f.parquet").exists()
