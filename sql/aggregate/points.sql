-- why: the detections of the vehicles used, each with the number of its pass
-- reads: @aggregate/chosen, @aggregate/passes
-- params: none
-- writes: run_id VARCHAR, pass_code INTEGER, track_id BIGINT, sign_class VARCHAR, lon DOUBLE, lat DOUBLE,
--         var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT
    chosen.run_id,
    pass_code,
    chosen.* EXCLUDE (run_id, vehicle_id, pass_id)
FROM chosen
JOIN passes USING (run_id, vehicle_id, pass_id)
