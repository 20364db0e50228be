-- why: the passes that may use a track id twice: fewer different ids than usable rows, or more than one vehicle
-- reads: @aggregate/reporting
-- params: none
-- writes: run_id VARCHAR, pass_id VARCHAR
SELECT
    run_id,
    pass_id
FROM reporting
WHERE n_usable > 0
GROUP BY run_id, pass_id
HAVING count(*) > 1 OR sum(n_track_ids) < sum(n_usable)
