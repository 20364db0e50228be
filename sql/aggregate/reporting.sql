-- why: what every pass reports: rows, usable rows and the range of their track ids. Vehicles and passes, the count of bad
--      rows and the search for repeated keys all start from here, so that the detections are not scanned for each
-- reads: @aggregate/judged
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, n_rows BIGINT, n_usable BIGINT, track_low BIGINT,
--         track_high BIGINT
SELECT
    run_id,
    vehicle_id,
    pass_id,
    count(*) AS n_rows,
    count(*) FILTER (WHERE reason IS NULL) AS n_usable,
    min(track_id) FILTER (WHERE reason IS NULL) AS track_low,
    max(track_id) FILTER (WHERE reason IS NULL) AS track_high
FROM judged
GROUP BY run_id, vehicle_id, pass_id
