-- why: the tracks of one run in the order of their key
-- reads: @aggregate/tracks
-- params: $run_id (text, the run)
-- writes: pass_id VARCHAR, track_id BIGINT, pass_hash UBIGINT, sign_class VARCHAR, lon DOUBLE, lat DOUBLE,
--         t_first_us BIGINT, t_last_us BIGINT, n_frames BIGINT, frame_first BIGINT, frame_last BIGINT, sigma_e_m DOUBLE,
--         sigma_n_m DOUBLE, cov_en_m2 DOUBLE, range_mean_m DOUBLE, view_deg DOUBLE, info_lon DOUBLE, info_lat DOUBLE,
--         info_matrix DOUBLE[], info_vector DOUBLE[], info_s0 DOUBLE, info_dof DOUBLE
SELECT * EXCLUDE (run_id)
FROM tracks
WHERE run_id = $run_id
ORDER BY pass_id, track_id
