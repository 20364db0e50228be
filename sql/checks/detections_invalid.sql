-- why: detections that cannot be placed, classed or named
-- reads: @aggregate/judged
-- params: none
-- writes: reason VARCHAR, run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR,
--         lon DOUBLE, lat DOUBLE
SELECT
    reason,
    run_id,
    vehicle_id,
    pass_id,
    track_id,
    sign_class,
    lon,
    lat
FROM judged
WHERE reason IS NOT NULL
ORDER BY ALL
