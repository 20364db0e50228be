-- why: the detections that can be used, each key once
-- reads: @aggregate/judged, @aggregate/copies
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR, lon DOUBLE,
--         lat DOUBLE, n_frames BIGINT, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT,
--         info_lon DOUBLE, info_lat DOUBLE, info_matrix DOUBLE[], info_vector DOUBLE[], info_s0 DOUBLE, info_dof DOUBLE
SELECT * EXCLUDE (reason) FROM judged ANTI JOIN copies USING (run_id, pass_id, track_id) WHERE reason IS NULL
UNION ALL
SELECT * EXCLUDE (reason, copy) FROM copies WHERE copy = 1
