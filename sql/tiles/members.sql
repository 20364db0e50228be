-- why: every detection in the tile that owns it and, as halo, in every other tile that must know it. For analysts: the
--      step deals the rows of aggregate/coded in a compiled kernel (algorithms/dealing), and a test demands the same rows
-- reads: @tiles/located, @tiles/readers
-- params: none
-- writes: batch INTEGER, tile_code INTEGER, is_owned BOOLEAN, pass_code INTEGER, track_id BIGINT, class_code INTEGER,
--         lon DOUBLE, lat DOUBLE, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT
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
    class_confidence,
    t_first_us,
    t_last_us
FROM located
JOIN readers
    ON readers.run_id = located.run_id
    AND readers.cell_x = floor(x)::INTEGER
    AND readers.cell_y = floor(y)::INTEGER
WHERE x BETWEEN west AND east AND y BETWEEN north AND south
