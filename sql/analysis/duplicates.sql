-- why: Is a sign in the map twice? Pairs of mapped signs of one class nearer than 8 m to each other
-- reads: signs AS fused
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, sign_class VARCHAR, sign_id VARCHAR, other_id VARCHAR,
--         distance_m DOUBLE, n_passes BIGINT, other_n_passes BIGINT
WITH given AS (
    SELECT 8.0 AS near_m
),

pairs AS (
    SELECT
        a.run_id,
        a.method,
        a.n_vehicles,
        a.sign_class,
        a.sign_id,
        b.sign_id AS other_id,
        ST_Distance_Spheroid(ST_Point2D(a.bbox.xmin, a.bbox.ymin), ST_Point2D(b.bbox.xmin, b.bbox.ymin)) AS distance_m,
        a.n_passes,
        b.n_passes AS other_n_passes
    FROM fused AS a
    CROSS JOIN (VALUES (-1), (0), (1)) AS step (band)
    JOIN fused AS b
        -- bands of latitude, 11 m wide: the join is on a band and its neighbours, not on every pair
        ON floor(b.bbox.ymin * 10000) = floor(a.bbox.ymin * 10000) + step.band
        AND b.sign_class = a.sign_class
        AND b.sign_id > a.sign_id
        AND b.run_id IS NOT DISTINCT FROM a.run_id
        AND b.method IS NOT DISTINCT FROM a.method
        AND b.n_vehicles IS NOT DISTINCT FROM a.n_vehicles
)

SELECT *
FROM pairs
WHERE distance_m < (SELECT near_m FROM given)
ORDER BY distance_m, run_id, method, n_vehicles, sign_id, other_id
