-- why: a number for every pass, in the order of the key, and a hash that names it in the ids of signs; md5 because it
--      is the same in every version of DuckDB
-- reads: @aggregate/points
-- params: none
-- writes: run_id VARCHAR, pass_id VARCHAR, pass_code BIGINT, pass_hash UBIGINT
SELECT
    run_id,
    pass_id,
    row_number() OVER (ORDER BY run_id, pass_id) - 1 AS pass_code,
    md5_number_lower(concat(run_id, '/', pass_id)) AS pass_hash
FROM (SELECT DISTINCT run_id, pass_id FROM points)
ORDER BY pass_code
