-- why: the usable detections of the vehicles used with all that joint fusion reads of them, each key once
-- reads: @aggregate/usable, @aggregate/passes, detections
-- params: none
-- writes: run_id VARCHAR, pass_id VARCHAR, track_id BIGINT, pass_hash UBIGINT, sign_class VARCHAR, lon DOUBLE, lat DOUBLE,
--         t_first_us BIGINT, t_last_us BIGINT, n_frames BIGINT, frame_first BIGINT, frame_last BIGINT, sigma_e_m DOUBLE,
--         sigma_n_m DOUBLE, cov_en_m2 DOUBLE, range_mean_m DOUBLE, view_deg DOUBLE, info_lon DOUBLE, info_lat DOUBLE,
--         info_matrix DOUBLE[], info_vector DOUBLE[], info_s0 DOUBLE, info_dof DOUBLE
SELECT
    usable.run_id,
    usable.pass_id,
    usable.track_id,
    pass_hash,
    usable.sign_class,
    lon,
    lat,
    t_first_us,
    t_last_us,
    detections.n_frames,
    frame_first,
    frame_last,
    detections.sigma_e_m,
    detections.sigma_n_m,
    detections.cov_en_m2,
    range_mean_m,
    view_deg,
    usable.info_lon,
    usable.info_lat,
    usable.info_matrix::DOUBLE[] AS info_matrix,
    usable.info_vector::DOUBLE[] AS info_vector,
    usable.info_s0,
    usable.info_dof
FROM usable
JOIN passes USING (run_id, vehicle_id, pass_id)
JOIN detections USING (run_id, vehicle_id, pass_id, track_id)
WHERE detections.bbox.xmin = lon AND detections.bbox.ymin = lat AND detections.sign_class = usable.sign_class
-- a key that stands there twice in full, too
QUALIFY row_number() OVER (
    PARTITION BY usable.run_id, usable.pass_id, usable.track_id
    ORDER BY detections.n_frames, detections.sigma_e_m, detections.sigma_n_m, detections.view_deg, usable.info_s0
) = 1
