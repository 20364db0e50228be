-- why: the detections of the vehicles used, each with the number of its pass
-- reads: @aggregate/placed, @aggregate/passes
-- params: none
-- writes: run_id VARCHAR, pass_code INTEGER, track_id BIGINT, sign_class VARCHAR, lon DOUBLE, lat DOUBLE,
--         var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT
    placed.run_id,
    pass_code,
    placed.* EXCLUDE (run_id, vehicle_id, pass_id)
FROM placed
JOIN passes USING (run_id, vehicle_id, pass_id)
