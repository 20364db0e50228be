-- why: all but the first of the usable detections that share a key
-- reads: @aggregate/copies
-- params: none
-- writes: reason VARCHAR, run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR,
--         lon DOUBLE, lat DOUBLE
SELECT
    'key repeated' AS reason,
    run_id,
    vehicle_id,
    pass_id,
    track_id,
    sign_class,
    lon,
    lat
FROM copies
WHERE copy > 1
ORDER BY ALL
