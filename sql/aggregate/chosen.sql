-- why: the detections of the first vehicles of every run; not needed when all are used
-- reads: @aggregate/placed, @aggregate/fleet
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR, lon DOUBLE,
--         lat DOUBLE, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT *
FROM placed
SEMI JOIN fleet USING (run_id, vehicle_id)
