-- why: counts and sums of squared errors per run, tile and concept, and over all tiles and all concepts, from the
--      outcomes of single signs; every score is derived from these, so tile, concept and total agree
-- reads: matches
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, tile VARCHAR, concept VARCHAR, tp BIGINT, fp BIGINT,
--         fn BIGINT, sum_sq_error_m2 DOUBLE
SELECT
    run_id,
    method,
    n_vehicles,
    coalesce(tile, 'all') AS tile,
    coalesce(concept, 'all') AS concept,
    count(*) FILTER (outcome = 'TP') AS tp,
    count(*) FILTER (outcome = 'FP') AS fp,
    count(*) FILTER (outcome = 'FN') AS fn,
    -- in the order of the key, so that the sum does not depend on the plan
    coalesce(list_sum(list(distance_m * distance_m ORDER BY ref_id) FILTER (outcome = 'TP')), 0.0) AS sum_sq_error_m2
FROM (SELECT *, coalesce(ref_concept, fused_concept) AS concept FROM matches)
GROUP BY run_id, method, n_vehicles, CUBE (tile, concept)
ORDER BY run_id, method, n_vehicles, tile, concept
