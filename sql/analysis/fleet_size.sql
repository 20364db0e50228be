-- why: How does quality grow with the fleet? Mean scores over the runs of every method and fleet size, and how many runs
--      have no GOSPA_M: a mean over the others is too good
-- reads: scores
-- params: none
-- writes: method VARCHAR, n_vehicles BIGINT, n_runs BIGINT, n_null BIGINT, f1_mean DOUBLE, gospa_m_mean DOUBLE,
--         gospa_m_sd DOUBLE, rmse_mean_m DOUBLE
SELECT
    method,
    n_vehicles,
    count(*) AS n_runs,
    count(*) FILTER (gospa_m IS NULL) AS n_null,
    avg(f1) AS f1_mean,
    avg(gospa_m) AS gospa_m_mean,
    stddev_samp(gospa_m) AS gospa_m_sd,
    avg(rmse_m) AS rmse_mean_m
FROM scores
WHERE tile = 'all' AND concept = 'all'
GROUP BY method, n_vehicles
ORDER BY method, n_vehicles
