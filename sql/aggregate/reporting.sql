-- why: what every pass reports: rows, usable rows and, where a bit string of $low to $high can hold them, different track
--      ids. Vehicles and passes, the count of bad rows and the search for repeated keys all start from here, so that the
--      detections are not scanned for each. Of one plain file `geofleet/tables/plain.py` says the same, and a test
--      demands the same rows
-- reads: @aggregate/judged
-- params: $low (bigint, smallest track id; 0 if not given), $high (bigint, largest track id; 0 if not given),
--         $is_narrow (boolean, ids fit bit strings; false if not given)
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, n_rows BIGINT, n_usable BIGINT, n_track_ids BIGINT
SELECT
    run_id,
    vehicle_id,
    pass_id,
    count(*) AS n_rows,
    count(*) FILTER (WHERE reason IS NULL) AS n_usable,
    bit_count(
        bitstring_agg(CASE WHEN $is_narrow THEN track_id ELSE $low END, $low, $high) FILTER (WHERE reason IS NULL)
    )::BIGINT AS n_track_ids
FROM judged
GROUP BY run_id, vehicle_id, pass_id
