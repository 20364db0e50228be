-- why: every score from counts and sums of squared errors, in SQL alone: what `derive_scores` does in Python
-- reads: @evaluate/counts
-- params: $gate_m (double, metres: c, the gate of the matching; 2 if not given)
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, tile VARCHAR, concept VARCHAR, tp BIGINT, fp BIGINT,
--         fn BIGINT, sum_sq_error_m2 DOUBLE, precision DOUBLE, recall DOUBLE, f1 DOUBLE, mse_m2 DOUBLE,
--         rmse_m DOUBLE, gospa DOUBLE, gospa_m DOUBLE, null_reason VARCHAR, cardinality_m2 DOUBLE
SELECT
    run_id,
    method,
    n_vehicles,
    tile,
    concept,
    tp,
    fp,
    fn,
    sum_sq_error_m2,
    -- a score without a denominator is null, never 0 and never infinite
    tp / nullif(tp + fp, 0) AS precision,
    tp / nullif(tp + fn, 0) AS recall,
    2 * tp / nullif(2 * tp + fp + fn, 0) AS f1,
    sum_sq_error_m2 / nullif(tp, 0) AS mse_m2,
    sqrt(sum_sq_error_m2 / nullif(tp, 0)) AS rmse_m,
    sqrt(sum_sq_error_m2 + $gate_m * $gate_m / 2 * (fn + fp)) AS gospa,
    sqrt((sum_sq_error_m2 + $gate_m * $gate_m / 2 * (fn + fp)) / nullif(tp, 0)) AS gospa_m,
    CASE
        WHEN tp > 0 THEN NULL
        WHEN fp = 0 AND fn = 0 THEN 'the map and the reference are empty'
        WHEN fp = 0 THEN 'the map is empty'
        WHEN fn = 0 THEN 'the reference is empty'
        ELSE 'no point of the map matches the reference'
    END AS null_reason,
    $gate_m * $gate_m / 2 * (fn + fp) / nullif(tp, 0) AS cardinality_m2
FROM counts
ORDER BY run_id, method, n_vehicles, tile, concept
