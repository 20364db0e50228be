-- why: the usable detections of the vehicles used, each key once
-- reads: @aggregate/judged, @aggregate/copies, @aggregate/passes
-- params: none
-- writes: run_id VARCHAR, pass_code INTEGER, track_id BIGINT, sign_class VARCHAR, lon DOUBLE, lat DOUBLE,
--         n_frames BIGINT, spread_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT
    usable.run_id,
    pass_code,
    usable.* EXCLUDE (reason, run_id, vehicle_id, pass_id)
FROM (
    SELECT * FROM judged ANTI JOIN copies USING (run_id, pass_id, track_id) WHERE reason IS NULL
    UNION ALL
    SELECT * EXCLUDE (copy) FROM copies WHERE copy = 1
) AS usable
JOIN passes USING (run_id, vehicle_id, pass_id)
