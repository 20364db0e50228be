-- why: Why was a sign missed that passes had in view? Its detections, those of the right class, and what the map has
--      instead within 5 m: none detected, wrong class, off by more than the gate, or lost in the aggregation
-- reads: matches, reference, truth
-- params: none
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, ref_id VARCHAR, ref_class VARCHAR,
--         n_passes_in_view BIGINT, n_detections BIGINT, n_right_class BIGINT, cause VARCHAR
WITH given AS (
    SELECT 5.0 AS near_m
),

detected AS (
    SELECT
        run_id,
        ref_sign_id,
        count(*) AS n_detections,
        count(*) FILTER (semantic_correct) AS n_right_class
    FROM truth
    WHERE ref_sign_id IS NOT NULL
    GROUP BY ALL
),

missed AS (
    SELECT
        m.*,
        r.n_passes_in_view,
        coalesce(d.n_detections, 0) AS n_detections,
        coalesce(d.n_right_class, 0) AS n_right_class
    FROM matches AS m
    JOIN reference AS r ON r.sign_id = m.ref_id AND r.run_id = m.run_id
    LEFT JOIN detected AS d ON d.ref_sign_id = m.ref_id AND d.run_id = m.run_id
    WHERE m.outcome = 'FN' AND r.n_passes_in_view > 0
),

instead AS (
    SELECT
        m.run_id,
        m.method,
        m.n_vehicles,
        m.ref_id,
        bool_or(f.fused_class = m.ref_class) AS has_class,
        bool_or(f.fused_class <> m.ref_class) AS has_other
    FROM missed AS m
    CROSS JOIN (VALUES (-1), (0), (1)) AS step (band)
    JOIN matches AS f
        ON f.outcome = 'FP'
        -- bands of latitude, 11 m wide: the join is on a band and its neighbours, not on every pair
        AND floor(f.bbox.ymin * 10000) = floor(m.bbox.ymin * 10000) + step.band
        AND f.run_id = m.run_id
        AND f.method = m.method
        AND f.n_vehicles = m.n_vehicles
        AND ST_Distance_Spheroid(
            ST_Point2D(f.bbox.xmin, f.bbox.ymin), ST_Point2D(m.bbox.xmin, m.bbox.ymin)
        ) < (SELECT near_m FROM given)
    GROUP BY ALL
)

SELECT
    m.run_id,
    m.method,
    m.n_vehicles,
    m.ref_id,
    m.ref_class,
    m.n_passes_in_view,
    m.n_detections,
    m.n_right_class,
    CASE
        WHEN m.n_detections = 0 THEN 'never detected'
        WHEN i.has_class THEN 'mapped too far off'
        WHEN i.has_other THEN 'mapped with another class'
        ELSE 'lost in the aggregation'
    END AS cause
FROM missed AS m
LEFT JOIN instead AS i USING (run_id, method, n_vehicles, ref_id)
ORDER BY m.run_id, m.method, m.n_vehicles, m.ref_id
