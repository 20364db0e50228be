"""The schema of every table, once: columns with type, unit, nullability and meaning, and the key rows are sorted by.

Documentation, SQL contract tests, readers and writers all derive from the objects here.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType

import pyarrow as pa

GEOMETRY = "geometry"
BBOX = "bbox"
BBOX_TYPE = pa.struct([(side, pa.float64()) for side in ("xmin", "ymin", "xmax", "ymax")])

TEXT, INT, FLOAT, FLAG = pa.string(), pa.int64(), pa.float64(), pa.bool_()
TIME = pa.timestamp("us", tz="UTC")


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: name (units are its suffix), Arrow type, meaning, and whether a value may be missing."""

    name: str
    type: pa.DataType
    description: str
    nullable: bool = False


@dataclass(frozen=True, slots=True)
class Schema:
    """A table: name, meaning, key, columns, geometry type ("" = no geometry) and whether the geometry may be missing.

    `optional` columns may be absent from a file; when present they have the type given here.
    """

    name: str
    description: str
    key: tuple[str, ...]
    columns: tuple[Column, ...]
    geometry: str = ""
    geometry_nullable: bool = False
    optional: tuple[Column, ...] = ()
    partitions: tuple[str, ...] = ()

    @property
    def all_columns(self) -> tuple[Column, ...]:
        """Required, then optional columns; geometry and bbox are not among them."""
        return self.columns + self.optional

    def arrow(self, names: tuple[str, ...] | None = None) -> pa.Schema:
        """Return the Arrow schema of the stored table, with `names` of optional columns (default: all of them).

        Geometry is WKB; `bbox` is the covering of GeoParquet 1.1.
        """
        kept = self.columns + tuple(c for c in self.optional if names is None or c.name in names)
        fields = [pa.field(c.name, c.type, c.nullable, metadata={b"description": c.description.encode()}) for c in kept]
        if self.geometry:
            fields.append(pa.field(GEOMETRY, pa.binary(), self.geometry_nullable))
            fields.append(pa.field(BBOX, BBOX_TYPE, self.geometry_nullable))
        return pa.schema(fields)


def _c(name: str, type_: pa.DataType, description: str) -> Column:
    """Read `name?` as a column whose value may be missing, as the design writes it."""
    return Column(name.rstrip("?"), type_, description, nullable=name.endswith("?"))


RUN = _c("run_id", TEXT, "one scenario, seed and replicate; runs are never mixed")
METHOD = _c("method", TEXT, "how the map was made, e.g. dbscan-peaks")
N_VEHICLES = _c("n_vehicles", INT, "the first n vehicles of the run were used; 0 for a map from elsewhere")

_SIGN = (
    _c("sign_id", TEXT, "stable id of the sign within its source"),
    _c("kind", TEXT, "main, plate, light, marking or other; maps are made and scored on main"),
    _c("parent_id?", TEXT, "a plate's main sign"),
    _c("concept", TEXT, "what the sign means, a concept of the taxonomy, or raw:<code> when unknown"),
    _c("value?", FLOAT, "the number on the sign, e.g. 50"),
    _c("unit?", TEXT, "unit of the value, e.g. km/h"),
    _c("sign_class", TEXT, "concept and value, e.g. speed_limit:50: what classes are compared by"),
    _c("raw_code", TEXT, "the code as the source has it"),
    _c("country?", TEXT, "ISO 3166-1 alpha-2"),
    _c("facing_deg?", FLOAT, "the way the sign's face looks, degrees clockwise from north"),
    _c("height_m?", FLOAT, "of the plate above the ground"),
    _c("support_id?", TEXT, "pole, gantry or node that carries the sign"),
    _c("road_id?", TEXT, "the road that the sign stands at"),
    _c("source", TEXT, "file or layer that the sign came from"),
    _c("source_ref", TEXT, "element of the source, e.g. node/123"),
    _c("first_seen?", TIME, "first observation"),
    _c("last_seen?", TIME, "last observation"),
)

_FUSED = (
    _c("var_e_m2?", FLOAT, "variance of the position, east"),
    _c("var_n_m2?", FLOAT, "variance of the position, north"),
    _c("cov_en_m2?", FLOAT, "covariance of the position, east and north"),
    _c("existence?", FLOAT, "probability that the sign exists"),
    _c("class_confidence?", FLOAT, "share or probability of the class given"),
    _c("n_passes?", INT, "passes that reported the sign"),
    _c("n_detections?", INT, "detections fused"),
    _c("n_opportunities?", INT, "passes that had the place in view"),
    _c("run_id?", TEXT, RUN.description),
    _c("method?", TEXT, METHOD.description),
    _c("n_vehicles?", INT, N_VEHICLES.description),
    _c("change?", TEXT, "keep, insert, remove, move or retype"),
    _c("map_version?", TEXT, "version of the map that the sign belongs to"),
)

_READ = (_c("country_revision?", TEXT, "edition of the country's catalogue of signs that the code is of"),)

SIGNS = Schema("signs", "a layer of signs from one source", ("sign_id",), _SIGN, "Point", optional=(*_READ, *_FUSED))

RUNS = Schema(
    "runs",
    "one simulated run: a scenario, a seed and a replicate",
    ("run_id",),
    (
        RUN,
        _c("scenario", TEXT, "name of the scenario"),
        _c("seed", INT, "seed of the study"),
        _c("replicate", INT, "number of the replicate, from 0"),
        _c("n_vehicles", INT, "vehicles simulated; a smaller fleet is the first of them"),
        _c("tracker", TEXT, "front end: paper, kalman or ideal"),
        _c("upload", TEXT, "what a vehicle sends: mean, or information"),
        _c("config_digest", TEXT, "first 16 hex digits of the SHA-256 of everything that shapes the run"),
    ),
)

REFERENCE = Schema(
    "reference",
    "the scene: the signs that a run simulates and is scored against",
    ("run_id", "sign_id"),
    (
        RUN,
        *_SIGN,
        _c("n_passes_in_view", INT, "passes that had the sign in view at least once"),
        _c("n_frames_in_view", INT, "frames, over all passes, that had the sign in view"),
    ),
    "Point",
)

LANES = Schema(
    "lanes",
    "lane or road lines",
    ("lane_id",),
    (
        _c("lane_id", TEXT, "stable id of the line within its source"),
        _c("road_id", TEXT, "the road it belongs to"),
        _c("kind", TEXT, "e.g. residential, driving"),
        _c("speed_limit_kmh?", FLOAT, "as the source has it"),
        _c("source", TEXT, "file that the line came from"),
    ),
    "LineString",
)

DRIVES = Schema(
    "drives",
    "trajectories, one row an epoch",
    ("drive_id", "seq"),
    (
        _c("drive_id", TEXT, "name of the drive"),
        _c("seq", INT, "number of the epoch, from 0"),
        _c("t_utc?", TIME, "time of the epoch"),
        _c("height_m?", FLOAT, "above the ellipsoid"),
        _c("heading_deg?", FLOAT, "from motion, degrees clockwise from north"),
        _c("speed_mps?", FLOAT, "from motion"),
        _c("fix_quality?", TEXT, "fixed, float, sbas, dgps, single, ppp or derived"),
        _c("sigma_e_m?", FLOAT, "standard deviation of the position, east, as declared"),
        _c("sigma_n_m?", FLOAT, "standard deviation of the position, north, as declared"),
        _c("segment", INT, "a gap starts a new one"),
        _c("source", TEXT, "file that the epoch came from"),
    ),
    "Point",
)

PASSES = Schema(
    "passes",
    "one vehicle's run over a drive: where a sign could have been seen",
    ("run_id", "pass_id"),
    (
        RUN,
        _c("pass_id", TEXT, "id of the pass within the run"),
        _c("vehicle_id", TEXT, "id of the vehicle within the run"),
        _c("sensor_id", TEXT, "one calibration"),
        _c("sensor_kind", TEXT, "e.g. camera"),
        _c("drive_id", TEXT, "the drive it follows"),
        _c("t_start?", TIME, "first frame"),
        _c("t_end?", TIME, "last frame"),
        _c("range_m", FLOAT, "range of the sensor"),
        _c("fov_deg", FLOAT, "full opening angle of the sensor"),
        _c("frame_spacing_m", FLOAT, "distance driven between frames"),
        _c("gnss_sigma_m?", FLOAT, "standard deviation a axis of the reported path, as declared by the car"),
    ),
    "LineString",
    optional=(
        _c("range_bias_sigma_m?", FLOAT, "declared standard deviation of what the sensor adds to every range"),
        _c(
            "bearing_bias_sigma_deg?",
            FLOAT,
            "declared standard deviation of what sensor and heading add to every bearing of the pass",
        ),
        _c("range_noise_sigma_m?", FLOAT, "declared standard deviation of a range, a frame"),
        _c("bearing_noise_sigma_deg?", FLOAT, "declared standard deviation of a bearing, a frame"),
        _c("false_negative_rate?", FLOAT, "declared probability that a frame misses a sign in view"),
        _c("semantic_rate?", FLOAT, "declared probability that a class is recognised"),
    ),
)

DETECTIONS = Schema(
    "detections",
    "what a pass reports for one tracked object: its mean position, spread and class",
    ("run_id", "pass_id", "track_id"),
    (
        RUN,
        _c("vehicle_id", TEXT, "id of the vehicle within the run"),
        _c("pass_id", TEXT, "id of the pass within the run"),
        _c("track_id", INT, "number of the track within the pass, from 0"),
        _c("t_first?", TIME, "first frame with the object"),
        _c("t_last?", TIME, "last frame with the object"),
        _c("frame_first?", INT, "number of the first frame with the object"),
        _c("frame_last?", INT, "number of the last frame with the object"),
        _c("n_frames?", INT, "frames with the object"),
        _c(
            "sigma_e_m?",
            FLOAT,
            "spread over frames, east, F - 1 in the denominator; not the error of the mean",
        ),
        _c("sigma_n_m?", FLOAT, "spread over frames, north"),
        _c("cov_en_m2?", FLOAT, "covariance over frames, east and north"),
        _c("range_mean_m?", FLOAT, "mean measured range"),
        _c("view_deg?", FLOAT, "mean direction of view, degrees clockwise from north"),
        _c("sign_class", TEXT, "class reported, by vote over frames"),
        _c("class_confidence?", FLOAT, "share of frames that voted for the class"),
    ),
    "Point",
    optional=(
        _c("class_votes?", pa.map_(TEXT, INT), "frames a class"),
        _c("raw_code?", TEXT, "code as the vehicle reported it"),
        _c("country?", TEXT, "ISO 3166-1 alpha-2"),
        _c("info_lon?", FLOAT, "origin of the information form, degrees: where N is linearised"),
        _c("info_lat?", FLOAT, "origin of the information form, degrees"),
        _c(
            "info_matrix?",
            pa.list_(FLOAT, 10),
            "upper triangle, by row, of N = sum of H'WH over frames; east, north, range bias (m), bearing bias (rad)",
        ),
        _c(
            "info_vector?",
            pa.list_(FLOAT, 4),
            "N times the estimate: east and north from the origin (m), range bias (m), bearing bias (rad)",
        ),
        _c(
            "info_s0?", FLOAT, "least weighted sum of squared residuals, chi-squared when the declared sigmas are right"
        ),
        _c("info_dof?", FLOAT, "degrees of freedom of info_s0: two a frame, less the rank of N"),
    ),
    partitions=("run_id", "vehicle_id"),
)

EVIDENCE = Schema(
    "evidence",
    "what joint fusion made of each detection: its sign, and how far it lies from it",
    ("run_id", "pass_id", "track_id"),
    (
        RUN,
        _c("pass_id", TEXT, "pass of the detection"),
        _c("track_id", INT, "number of the detection within the pass"),
        _c("sign_id", TEXT, "sign that it was associated to, whether that sign is in the map or not"),
        _c("is_in_map", FLAG, "the sign is in the map: its existence times its class confidence is above one half"),
        _c("existence", FLOAT, "probability that the sign exists"),
        _c("sign_class", TEXT, "class of the sign"),
        _c("read_class", TEXT, "class that the detection reported"),
        _c(
            "residual_e_m",
            FLOAT,
            "place of the detection, offset and bias of its pass taken out, less the sign's, east",
        ),
        _c("residual_n_m", FLOAT, "the same, north"),
        _c("chi2", FLOAT, "squared residual in standard deviations, two degrees of freedom"),
    ),
)

NUISANCE = Schema(
    "nuisance",
    "what joint fusion found that all detections of a pass have in common",
    ("run_id", "pass_id"),
    (
        RUN,
        _c("pass_id", TEXT, "the pass; prior map for the translation of a prior map"),
        _c("sensor_kind", TEXT, "kind of its sensor"),
        _c("n_detections", INT, "detections of the pass"),
        _c("n_alone", INT, "of these, of signs that no other pass reports although three or more had them in view"),
        _c("offset_e_m", FLOAT, "offset of the reported path, east"),
        _c("offset_n_m", FLOAT, "the same, north"),
        _c("range_bias_m", FLOAT, "what the sensor adds to every range"),
        _c("bearing_bias_deg", FLOAT, "what sensor and heading add to every bearing, counter-clockwise"),
        _c("offset_chi2", FLOAT, "offset squared in declared standard deviations, two degrees of freedom"),
        _c("bias_chi2", FLOAT, "biases squared in declared standard deviations, two degrees of freedom"),
        _c("noise_factor", FLOAT, "factor on the declared variance of its frames, from its own residuals"),
        _c("jitter_m", FLOAT, "further error of its places an axis, from how they fit the other passes"),
        _c(
            "is_suspect",
            FLAG,
            "far from what it declares: a chi2 above 13.8 (1 in 1,000), noise_factor above 2, or mostly alone",
        ),
    ),
)

TRUTH = Schema(
    "truth",
    "which sign a simulated detection came from; only evaluation may open it",
    ("run_id", "pass_id", "track_id"),
    (
        RUN,
        _c("pass_id", TEXT, "id of the pass within the run"),
        _c("track_id", INT, "number of the track within the pass"),
        _c("ref_sign_id?", TEXT, "the sign most of its frames came from; missing for a ghost"),
        _c("ref_sign_class?", TEXT, "that sign's class"),
        _c("semantic_correct", FLAG, "the reported class is the sign's class"),
        _c("is_ghost", FLAG, "most of its frames came from no sign"),
    ),
)

_SCORED = (_c("run_id?", TEXT, RUN.description), METHOD, N_VEHICLES)

MATCHES = Schema(
    "matches",
    "the outcome of every sign of a map and of its reference; located at the reference sign, an FP at its own place",
    ("run_id", "method", "n_vehicles", "ref_id", "fused_id"),
    (
        *_SCORED,
        _c("fused_id?", TEXT, "sign of the map; missing for an FN"),
        _c("ref_id?", TEXT, "sign of the reference; missing for an FP"),
        _c("outcome", TEXT, "TP, FP or FN"),
        _c("tile", TEXT, "quadkey; a TP belongs to the tile of its reference sign"),
        _c("distance_m?", FLOAT, "between the matched signs"),
        _c("fused_class?", TEXT, "class in the map"),
        _c("ref_class?", TEXT, "class in the reference"),
        _c("fused_concept?", TEXT, "concept in the map"),
        _c("ref_concept?", TEXT, "concept in the reference"),
        _c("class_agrees?", FLAG, "both classes are equal; missing without a match"),
    ),
    "Point",
)

SCORES = Schema(
    "scores",
    "counts and sums of squares, and the scores derived from them; p is 2, alpha is 2",
    ("run_id", "method", "n_vehicles", "tile", "concept"),
    (
        *_SCORED,
        _c("tile", TEXT, "quadkey, or all"),
        _c("concept", TEXT, "concept, or all"),
        _c("gate_m", FLOAT, "c, the largest distance of a match (exclusive)"),
        _c("match_on", TEXT, "class, concept or none"),
        _c("tp", INT, "matched pairs"),
        _c("fp", INT, "signs of the map without a match"),
        _c("fn", INT, "signs of the reference without a match"),
        _c("sum_sq_error_m2", FLOAT, "sum of squared distances of the matched pairs"),
        _c("precision?", FLOAT, "tp / (tp + fp)"),
        _c("recall?", FLOAT, "tp / (tp + fn)"),
        _c("f1?", FLOAT, "2 tp / (2 tp + fp + fn)"),
        _c("mse_m2?", FLOAT, "sum_sq_error_m2 / tp"),
        _c("rmse_m?", FLOAT, "square root of mse_m2"),
        _c("gospa", FLOAT, "square root of sum_sq_error_m2 + gate_m² / 2 (fp + fn), metres"),
        _c("gospa_m?", FLOAT, "GOSPA_M = gospa / square root of tp, metres"),
        _c("null_reason?", TEXT, "why a score is missing"),
    ),
    "Polygon",
    geometry_nullable=True,
    optional=(_c("cardinality_m2?", FLOAT, "gate_m² / 2 (fp + fn) / tp; with mse_m2 the two parts of gospa_m²"),),
)

STUDY_SCORES = Schema(
    "study_scores",
    "the scores of a study: one row a fleet, method and fleet size, over all tiles",
    ("scenario", "place", "setting", "method", "n_vehicles", "replicate"),
    (
        _c("scenario", TEXT, "name of the scenario"),
        _c("place", TEXT, "where: the drive, or a name that the study gives it"),
        _c("setting", TEXT, "what the scenario is changed in, e.g. semantic_rate=0.98; empty when in nothing"),
        METHOD,
        N_VEHICLES,
        _c("seed", INT, "seed of the study"),
        _c("replicate", INT, "number of the fleet, from 0"),
        RUN,
        _c("tracker", TEXT, "front end: paper, kalman or ideal"),
        _c("upload", TEXT, "what the method reads of a detection: mean, or information"),
        *(c for c in (*SCORES.columns, *SCORES.optional) if c not in _SCORED and c.name not in ("tile", "concept")),
    ),
)

SCHEMAS = MappingProxyType(
    {
        s.name: s
        for s in (
            *(SIGNS, RUNS, REFERENCE, LANES, DRIVES, PASSES, DETECTIONS, TRUTH),
            *(EVIDENCE, NUISANCE, MATCHES, SCORES, STUDY_SCORES),
        )
    }
)
