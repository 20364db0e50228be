-- why: Which vehicles report badly? Share of ghosts and of wrong classes, and how far detections lie from their signs
-- reads: detections, truth, reference
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, n_detections BIGINT, share_ghosts DOUBLE, share_wrong_class DOUBLE,
--         rmse_m DOUBLE
SELECT
    d.run_id,
    d.vehicle_id,
    count(*) AS n_detections,
    avg(t.is_ghost::INTEGER) AS share_ghosts,
    avg((NOT t.semantic_correct)::INTEGER) FILTER (NOT t.is_ghost) AS share_wrong_class,
    sqrt(
        avg(
            ST_Distance_Spheroid(ST_Point2D(d.bbox.xmin, d.bbox.ymin), ST_Point2D(r.bbox.xmin, r.bbox.ymin)) ** 2
        )
    ) AS rmse_m
FROM detections AS d
JOIN truth AS t USING (run_id, pass_id, track_id)
LEFT JOIN reference AS r ON r.sign_id = t.ref_sign_id AND r.run_id = d.run_id
GROUP BY d.run_id, d.vehicle_id
ORDER BY rmse_m DESC NULLS LAST, d.run_id, d.vehicle_id
