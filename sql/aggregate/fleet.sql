-- why: the vehicles used of every run: the first ones by id, so that a small fleet is part of every larger one
-- reads: @aggregate/reporting
-- params: $n_vehicles (integer, vehicles a run, 0 for all; 0 if not given)
-- writes: run_id VARCHAR, vehicle_id VARCHAR, n_reporting BIGINT
SELECT
    run_id,
    vehicle_id,
    count(*) OVER (PARTITION BY run_id) AS n_reporting
FROM (
    SELECT run_id, vehicle_id
    FROM (SELECT DISTINCT run_id, vehicle_id FROM reporting WHERE run_id IS NOT NULL AND vehicle_id IS NOT NULL)
    QUALIFY $n_vehicles = 0 OR row_number() OVER (PARTITION BY run_id ORDER BY vehicle_id) <= $n_vehicles
)
ORDER BY run_id, vehicle_id
