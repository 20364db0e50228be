-- why: the passes that use a track id twice: fewer different ids, counted in a bit string, than usable rows
-- reads: @aggregate/judged
-- params: $low (bigint, smallest track id), $high (bigint, largest track id)
-- writes: run_id VARCHAR, pass_id VARCHAR
SELECT
    run_id,
    pass_id
FROM judged
WHERE reason IS NULL
GROUP BY run_id, pass_id
HAVING bit_count(bitstring_agg(track_id, $low, $high)) < count(*)
