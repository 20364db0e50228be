-- why: Where is the map worst? Tiles by GOSPA_M, those where nothing matched first, with what went wrong there
-- reads: scores
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, tile VARCHAR, gospa_m DOUBLE, f1 DOUBLE, tp BIGINT,
--         fp BIGINT, fn BIGINT, rmse_m DOUBLE, null_reason VARCHAR
SELECT
    run_id,
    method,
    n_vehicles,
    tile,
    gospa_m,
    f1,
    tp,
    fp,
    fn,
    rmse_m,
    null_reason
FROM scores
WHERE tile <> 'all' AND concept = 'all'
ORDER BY gospa_m DESC NULLS FIRST, fp + fn DESC, run_id, method, n_vehicles, tile
