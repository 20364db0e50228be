-- why: the two ends of every match, to draw a line from a sign of the map to its reference sign
-- reads: matches, signs
-- params: $min_length_m (double, metres: shorter lines are left out; 0.002 if not given)
-- writes: run_id VARCHAR, method VARCHAR, n_vehicles BIGINT, fused_id VARCHAR, ref_id VARCHAR, ref_class VARCHAR,
--         distance_m DOUBLE, lon DOUBLE, lat DOUBLE, ref_lon DOUBLE, ref_lat DOUBLE
SELECT
    m.run_id,
    m.method,
    m.n_vehicles,
    m.fused_id,
    m.ref_id,
    m.ref_class,
    m.distance_m,
    s.bbox.xmin AS lon,
    s.bbox.ymin AS lat,
    m.bbox.xmin AS ref_lon,
    m.bbox.ymin AS ref_lat
FROM matches AS m
JOIN signs AS s
    ON s.sign_id = m.fused_id
    AND s.run_id IS NOT DISTINCT FROM m.run_id
    AND s.method = m.method
    AND s.n_vehicles = m.n_vehicles
WHERE m.outcome = 'TP' AND m.distance_m >= $min_length_m
ORDER BY m.run_id, m.method, m.n_vehicles, m.ref_id
