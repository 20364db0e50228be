-- why: the usable detections that share their key with another; copy 1, the first by its values, is the one kept
-- reads: @aggregate/judged, @aggregate/suspects
-- params: none
-- writes: reason VARCHAR, run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR,
--         lon DOUBLE, lat DOUBLE, n_frames BIGINT, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT,
--         t_last_us BIGINT, info_lon DOUBLE, info_lat DOUBLE, info_matrix DOUBLE[], info_vector DOUBLE[],
--         info_s0 DOUBLE, info_dof DOUBLE, copy BIGINT
WITH repeated AS (
    SELECT
        run_id,
        pass_id,
        track_id
    FROM judged
    SEMI JOIN suspects USING (run_id, pass_id)
    WHERE reason IS NULL
    GROUP BY run_id, pass_id, track_id
    HAVING count(*) > 1
)
SELECT
    judged.*,
    row_number() OVER (
        PARTITION BY run_id, pass_id, track_id
        ORDER BY lon, lat, sign_class, vehicle_id, n_frames, var_m2, class_confidence, t_first_us, t_last_us,
            info_vector, info_matrix, info_lon, info_lat
    ) AS copy
FROM judged
SEMI JOIN repeated USING (run_id, pass_id, track_id)
WHERE reason IS NULL
