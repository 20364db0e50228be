-- why: the detections of the vehicles used, each with the numbers of its pass and class; a missing number is NaN, a missing
--      time one that no minimum or maximum takes. Of one plain file `geofleet/tables/plain.py` says the same, and a test
--      demands the same rows
-- reads: @aggregate/chosen, @aggregate/passes, @aggregate/classes
-- params: none
-- writes: pass_code INTEGER, track_id BIGINT, class_code INTEGER, lon DOUBLE, lat DOUBLE, var_m2 DOUBLE,
--         class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
SELECT
    pass_code,
    track_id,
    class_code,
    lon,
    lat,
    var_m2,
    coalesce(class_confidence, 'nan'::DOUBLE) AS class_confidence,
    coalesce(t_first_us, 9223372036854775807) AS t_first_us,
    coalesce(t_last_us, -9223372036854775807 - 1) AS t_last_us
FROM chosen
JOIN passes USING (run_id, vehicle_id, pass_id)
JOIN classes USING (sign_class)
