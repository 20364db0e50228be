-- why: Do false signs gather at poles with several signs, where fleets mix classes up? Share of signs that are false by
--      the number of reference signs within 5 m
-- reads: matches
-- params: none
-- writes: method VARCHAR, n_vehicles BIGINT, n_signs_near BIGINT, n_mapped BIGINT, n_false BIGINT, share_false DOUBLE
WITH given AS (
    SELECT 5.0 AS near_m
),

mapped AS (
    SELECT
        f.run_id,
        f.method,
        f.n_vehicles,
        f.fused_id,
        f.outcome,
        count(r.ref_id) FILTER (
            ST_Distance_Spheroid(ST_Point2D(f.bbox.xmin, f.bbox.ymin), ST_Point2D(r.bbox.xmin, r.bbox.ymin))
            < (SELECT near_m FROM given)
        ) AS n_signs_near
    FROM matches AS f
    CROSS JOIN (VALUES (-1), (0), (1)) AS step (band)
    LEFT JOIN matches AS r
        ON r.ref_id IS NOT NULL
        -- bands of latitude, 11 m wide: the join is on a band and its neighbours, not on every pair
        AND floor(r.bbox.ymin * 10000) = floor(f.bbox.ymin * 10000) + step.band
        AND r.run_id IS NOT DISTINCT FROM f.run_id
        AND r.method = f.method
        AND r.n_vehicles = f.n_vehicles
    WHERE f.fused_id IS NOT NULL
    GROUP BY ALL
)

SELECT
    method,
    n_vehicles,
    n_signs_near,
    count(*) AS n_mapped,
    count(*) FILTER (outcome = 'FP') AS n_false,
    n_false / n_mapped AS share_false
FROM mapped
GROUP BY method, n_vehicles, n_signs_near
ORDER BY method, n_vehicles, n_signs_near
