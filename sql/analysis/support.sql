-- why: How many passes must report a sign before it can be believed? Share of mapped signs that are true by the number
--      of passes behind them; the first rows hold the signs with weak support
-- reads: matches, signs AS fused
-- params: none
-- writes: method VARCHAR, n_vehicles BIGINT, n_passes BIGINT, n_mapped BIGINT, n_true BIGINT, share_true DOUBLE,
--         rmse_m DOUBLE
SELECT
    m.method,
    m.n_vehicles,
    f.n_passes,
    count(*) AS n_mapped,
    count(*) FILTER (m.outcome = 'TP') AS n_true,
    n_true / n_mapped AS share_true,
    sqrt(avg(m.distance_m * m.distance_m)) AS rmse_m
FROM matches AS m
JOIN fused AS f
    ON f.sign_id = m.fused_id
    AND f.run_id IS NOT DISTINCT FROM m.run_id
    AND f.method = m.method
    AND f.n_vehicles = m.n_vehicles
GROUP BY m.method, m.n_vehicles, f.n_passes
ORDER BY m.method, m.n_vehicles, f.n_passes NULLS FIRST
