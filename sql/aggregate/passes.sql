-- why: a number for every pass of the vehicles used, in the order of the key, and a hash that names it in the ids of
--      signs; md5 because it is the same in every version of DuckDB
-- reads: @aggregate/reporting, @aggregate/fleet
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, pass_code INTEGER, pass_hash UBIGINT
SELECT
    run_id,
    vehicle_id,
    pass_id,
    (dense_rank() OVER (ORDER BY run_id, pass_id) - 1)::INTEGER AS pass_code,
    md5_number_lower(concat(run_id, '/', pass_id)) AS pass_hash
FROM reporting
SEMI JOIN fleet USING (run_id, vehicle_id)
WHERE n_usable > 0
ORDER BY pass_code, vehicle_id
