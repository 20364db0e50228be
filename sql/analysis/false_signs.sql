-- why: Where do false signs come from? Each with the nearest reference sign within 10 m, and what that suggests: the
--      sign itself put too far off, its class mistaken, a second copy of a found sign, another sign beside, or nothing
-- reads: matches
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, fused_id VARCHAR, fused_class VARCHAR, ref_id VARCHAR,
--         ref_class VARCHAR, distance_m DOUBLE, suggests VARCHAR
WITH given AS (
    SELECT 10.0 AS near_m
),

near AS (
    SELECT
        f.run_id,
        f.method,
        f.n_vehicles,
        f.fused_id,
        r.ref_id,
        r.ref_class,
        r.outcome,
        ST_Distance_Spheroid(
            ST_Point2D(f.bbox.xmin, f.bbox.ymin), ST_Point2D(r.bbox.xmin, r.bbox.ymin)
        ) AS apart_m
    FROM matches AS f
    CROSS JOIN (VALUES (-1), (0), (1)) AS step (band)
    JOIN matches AS r
        ON r.ref_id IS NOT NULL
        -- bands of latitude, 11 m wide: the join is on a band and its neighbours, not on every pair
        AND floor(r.bbox.ymin * 10000) = floor(f.bbox.ymin * 10000) + step.band
        AND r.run_id IS NOT DISTINCT FROM f.run_id
        AND r.method = f.method
        AND r.n_vehicles = f.n_vehicles
    WHERE f.outcome = 'FP' AND apart_m < (SELECT near_m FROM given)
    -- of several signs on one pole, the one of the same class tells most
    QUALIFY row_number() OVER (
        PARTITION BY f.run_id, f.method, f.n_vehicles, f.fused_id
        ORDER BY round(apart_m, 2), r.ref_class = f.fused_class DESC, r.ref_id
    ) = 1
)

SELECT
    f.run_id,
    f.method,
    f.n_vehicles,
    f.fused_id,
    f.fused_class,
    n.ref_id,
    n.ref_class,
    n.apart_m AS distance_m,
    CASE
        WHEN n.ref_id IS NULL THEN 'no sign near by'
        WHEN n.ref_class = f.fused_class AND n.outcome = 'TP' THEN 'second copy of a found sign'
        WHEN n.ref_class = f.fused_class THEN 'the sign, too far off'
        WHEN n.outcome = 'FN' THEN 'the sign, with another class'
        ELSE 'beside a sign that is found'
    END AS suggests
FROM matches AS f
LEFT JOIN near AS n
    ON n.fused_id = f.fused_id
    AND n.run_id IS NOT DISTINCT FROM f.run_id
    AND n.method = f.method
    AND n.n_vehicles = f.n_vehicles
WHERE f.outcome = 'FP'
ORDER BY f.run_id, f.method, f.n_vehicles, distance_m, f.fused_id
