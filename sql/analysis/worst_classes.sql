-- why: Which classes are mapped worst? F1 and errors of every class, a false sign counted for the class it claims
-- reads: matches
-- params: none
-- writes: method VARCHAR, n_vehicles BIGINT, sign_class VARCHAR, f1 DOUBLE, tp BIGINT, fp BIGINT, fn BIGINT,
--         rmse_m DOUBLE
SELECT
    method,
    n_vehicles,
    coalesce(ref_class, fused_class) AS sign_class,
    2 * count(*) FILTER (outcome = 'TP') / (count(*) + count(*) FILTER (outcome = 'TP')) AS f1,
    count(*) FILTER (outcome = 'TP') AS tp,
    count(*) FILTER (outcome = 'FP') AS fp,
    count(*) FILTER (outcome = 'FN') AS fn,
    sqrt(avg(distance_m * distance_m)) AS rmse_m
FROM matches
GROUP BY ALL
ORDER BY f1, fp + fn DESC, method, n_vehicles, sign_class
