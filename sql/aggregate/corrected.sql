-- why: usable detections with the bias of their pass taken out: at q - K b from the origin of their information form,
--      with the variance that leaves, an axis. Those without the form stay where their vehicles put them. Stands in for
--      aggregate/placed
-- reads: @aggregate/solved, @aggregate/biases
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR, lon DOUBLE,
--         lat DOUBLE, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
WITH offsets AS (
    SELECT
        solved.*,
        q_e - k_er * range_bias_m - k_et * bearing_bias_rad AS e_m,
        q_n - k_nr * range_bias_m - k_nt * bearing_bias_rad AS n_m,
        (
            scale * (inv_ee + inv_nn)
            + (k_er * k_er + k_nr * k_nr) * var_rr
            + 2 * (k_er * k_et + k_nr * k_nt) * cov_rt
            + (k_et * k_et + k_nt * k_nt) * var_tt
        ) / 2 AS corrected_var_m2,
        radians(info_lat) AS phi,
        1 - 0.0066943799901413165 * sin(radians(info_lat)) ** 2 AS w -- WGS 84: radii of curvature from a and e²
    FROM solved
    JOIN biases USING (run_id, pass_id)
),
places AS ( -- to second order in the offset: 0.1 mm within 500 m at 60 degrees
    SELECT
        *,
        info_lat + degrees(
            n_m / (6378137 * (1 - 0.0066943799901413165) / w ** 1.5)
            - e_m * e_m * tan(phi) / (2 * 6378137 / sqrt(w) * 6378137 * (1 - 0.0066943799901413165) / w ** 1.5)
        ) AS corrected_lat,
        info_lon + degrees(
            e_m / (6378137 / sqrt(w) * cos(phi)) * (1 + n_m * tan(phi) / (6378137 / sqrt(w)))
        ) AS corrected_lon
    FROM offsets
)
SELECT
    run_id,
    vehicle_id,
    pass_id,
    track_id,
    sign_class,
    CASE
        WHEN e_m IS NULL THEN lon
        WHEN corrected_lon > 180 THEN corrected_lon - 360
        WHEN corrected_lon < -180 THEN corrected_lon + 360
        ELSE corrected_lon
    END AS lon,
    CASE WHEN e_m IS NULL THEN lat ELSE corrected_lat END AS lat,
    coalesce(corrected_var_m2, var_m2) AS var_m2,
    class_confidence,
    t_first_us,
    t_last_us
FROM places
