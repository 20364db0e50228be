-- why: Is the whole map shifted? Mean error of the matched signs to the east and north, and what is left when it is
--      taken away: a shift is what more vehicles of one GNSS error cannot average out
-- reads: matches, signs AS fused
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, n BIGINT, shift_e_m DOUBLE, shift_n_m DOUBLE,
--         rmse_m DOUBLE, rmse_unshifted_m DOUBLE
WITH errors AS (
    SELECT
        m.run_id,
        m.method,
        m.n_vehicles,
        m.distance_m,
        -- along the parallel and along the meridian of the reference sign
        sign(f.bbox.xmin - m.bbox.xmin) * ST_Distance_Spheroid(
            ST_Point2D(m.bbox.xmin, m.bbox.ymin), ST_Point2D(f.bbox.xmin, m.bbox.ymin)
        ) AS e_m,
        sign(f.bbox.ymin - m.bbox.ymin) * ST_Distance_Spheroid(
            ST_Point2D(m.bbox.xmin, m.bbox.ymin), ST_Point2D(m.bbox.xmin, f.bbox.ymin)
        ) AS n_m
    FROM matches AS m
    JOIN fused AS f
        ON f.sign_id = m.fused_id
        AND f.run_id IS NOT DISTINCT FROM m.run_id
        AND f.method = m.method
        AND f.n_vehicles = m.n_vehicles
    WHERE m.outcome = 'TP'
)

SELECT
    run_id,
    method,
    n_vehicles,
    count(*) AS n,
    avg(e_m) AS shift_e_m,
    avg(n_m) AS shift_n_m,
    sqrt(avg(distance_m * distance_m)) AS rmse_m,
    sqrt(var_pop(e_m) + var_pop(n_m)) AS rmse_unshifted_m
FROM errors
GROUP BY run_id, method, n_vehicles
ORDER BY run_id, method, n_vehicles
