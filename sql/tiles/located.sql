-- why: every detection with the numbers of its pass and class and its place among the cells, as in tiles/counts; a missing
--      number is NaN, a missing time one that no minimum or maximum takes
-- reads: @aggregate/points, @aggregate/classes
-- params: $fine_zoom (integer, zoom of the cells)
-- writes: run_id VARCHAR, pass_code INTEGER, track_id BIGINT, class_code INTEGER, lon DOUBLE, lat DOUBLE, var_m2 DOUBLE,
--         class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT, x DOUBLE, y DOUBLE
SELECT
    run_id,
    pass_code,
    track_id,
    class_code,
    lon,
    lat,
    var_m2,
    coalesce(class_confidence, 'nan'::DOUBLE) AS class_confidence,
    coalesce(t_first_us, 9223372036854775807) AS t_first_us,
    coalesce(t_last_us, -9223372036854775807 - 1) AS t_last_us,
    (CASE WHEN lon = 180 THEN 0 ELSE lon + 180 END) / 360 * (1 << $fine_zoom) AS x,
    (0.5 - ln((1 + sin(radians(lat))) / (1 - sin(radians(lat)))) / (4 * pi())) * (1 << $fine_zoom) AS y
FROM points
JOIN classes USING (sign_class)
