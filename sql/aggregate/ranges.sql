-- why: how far apart track ids are and about how many passes there are, which tells whether ids can be counted in bit
--      strings
-- reads: detections
-- params: none
-- writes: track_low BIGINT, track_high BIGINT, n_passes BIGINT
SELECT
    min(track_id) AS track_low,
    max(track_id) AS track_high,
    approx_count_distinct(pass_id) AS n_passes
FROM detections
