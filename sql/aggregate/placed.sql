-- why: usable detections where their vehicles put them
-- reads: @aggregate/usable
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR, lon DOUBLE,
--         lat DOUBLE, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT * EXCLUDE (n_frames, info_lon, info_lat, info_matrix, info_vector, info_s0, info_dof) FROM usable
