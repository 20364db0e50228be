-- why: Which classes are taken for which? Each missed sign with the false sign of another class that stands within 2 m
--      of it, the nearest one; pairs counted, the most frequent first
-- reads: matches
-- params: none
-- writes: method VARCHAR, n_vehicles BIGINT, ref_class VARCHAR, fused_class VARCHAR, n BIGINT, distance_mean_m DOUBLE
WITH given AS (
    SELECT 2.0 AS near_m
),

-- bands of latitude, 11 m wide: the join is on a band and its neighbours, not on every pair
missed AS (
    SELECT m.*, floor(m.bbox.ymin * 10000) + step.band AS band
    FROM matches AS m
    CROSS JOIN (VALUES (-1), (0), (1)) AS step (band)
    WHERE m.outcome = 'FN'
),

unfounded AS (
    SELECT *, floor(bbox.ymin * 10000) AS band FROM matches WHERE outcome = 'FP'
),

pairs AS (
    SELECT
        r.run_id,
        r.method,
        r.n_vehicles,
        r.ref_id,
        r.ref_class,
        f.fused_class,
        ST_Distance_Spheroid(
            ST_Point2D(f.bbox.xmin, f.bbox.ymin), ST_Point2D(r.bbox.xmin, r.bbox.ymin)
        ) AS apart_m
    FROM missed AS r
    JOIN unfounded AS f
        ON f.band = r.band
        AND f.fused_class <> r.ref_class
        AND f.run_id IS NOT DISTINCT FROM r.run_id
        AND f.method = r.method
        AND f.n_vehicles = r.n_vehicles
    WHERE apart_m < (SELECT near_m FROM given)
    QUALIFY row_number() OVER (
        PARTITION BY r.run_id, r.method, r.n_vehicles, r.ref_id ORDER BY apart_m, f.fused_id
    ) = 1
)

SELECT
    method,
    n_vehicles,
    ref_class,
    fused_class,
    count(*) AS n,
    avg(apart_m) AS distance_mean_m
FROM pairs
GROUP BY method, n_vehicles, ref_class, fused_class
ORDER BY n DESC, method, n_vehicles, ref_class, fused_class
