-- why: every detection in the tile that owns it and, as halo, in every other tile that must know it; a missing number is
--      NaN, a missing time one that no minimum or maximum takes
-- reads: @aggregate/points, @aggregate/classes, @tiles/readers
-- params: $fine_zoom (integer, zoom of the cells)
-- writes: batch INTEGER, tile_code INTEGER, is_owned BOOLEAN, pass_code INTEGER, track_id BIGINT, class_code INTEGER,
--         lon DOUBLE, lat DOUBLE, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
WITH located AS (
    SELECT
        *,
        (lon + 180) / 360 * (1 << $fine_zoom) AS x, -- as in tiles/counts
        (0.5 - ln((1 + sin(radians(lat))) / (1 - sin(radians(lat)))) / (4 * pi())) * (1 << $fine_zoom) AS y
    FROM points
)
SELECT
    batch,
    tile_code,
    is_owned,
    pass_code,
    track_id,
    class_code,
    lon,
    lat,
    var_m2,
    coalesce(class_confidence, 'nan'::DOUBLE) AS class_confidence,
    coalesce(t_first_us, 9223372036854775807) AS t_first_us,
    coalesce(t_last_us, -9223372036854775807 - 1) AS t_last_us
FROM located
JOIN classes USING (sign_class)
JOIN readers
    ON readers.run_id = located.run_id
    AND cell_x = floor(x)::INTEGER % (1 << $fine_zoom)
    AND cell_y = floor(y)::INTEGER
WHERE x BETWEEN west AND east AND y BETWEEN north AND south
