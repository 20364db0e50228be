-- why: every detection with its run and its place among the cells, as in tiles/counts
-- reads: @aggregate/coded, @aggregate/passes
-- params: $fine_zoom (integer, zoom of the cells; 18 if not given)
-- writes: run_id VARCHAR, pass_code INTEGER, track_id BIGINT, class_code INTEGER, lon DOUBLE, lat DOUBLE, var_m2 DOUBLE,
--         class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT, x DOUBLE, y DOUBLE
SELECT
    run_id,
    coded.*,
    (CASE WHEN lon = 180 THEN 0 ELSE lon + 180 END) / 360 * (1 << $fine_zoom) AS x,
    (0.5 - ln((1 + sin(radians(lat))) / (1 - sin(radians(lat)))) / (4 * pi())) * (1 << $fine_zoom) AS y
FROM coded
JOIN (SELECT DISTINCT run_id, pass_code FROM passes) AS runs_of_passes USING (pass_code)
