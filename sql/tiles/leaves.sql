-- why: the tile of every cell: at $zoom, or where that owns more than $batch_rows detections the first deeper one that
--      does not (a hot tile is split by quadkey depth, down to the cells themselves)
-- reads: @tiles/counts
-- params: $zoom (integer, tile zoom; 14 if not given),
--         $fine_zoom (integer, zoom of the cells; 18 if not given),
--         $batch_rows (integer, detections; 100000 if not given)
-- writes: run_id VARCHAR, cell_x INTEGER, cell_y INTEGER, n_points BIGINT, zoom INTEGER, tile VARCHAR
WITH levels AS (
    SELECT
        counts.*,
        level::INTEGER AS zoom,
        sum(n_points) OVER (
            PARTITION BY run_id, level, cell_x >> ($fine_zoom - level), cell_y >> ($fine_zoom - level)
        ) AS n_in_tile
    FROM counts, unnest(range($zoom, $fine_zoom + 1)) AS levels_(level)
)
SELECT
    run_id,
    cell_x,
    cell_y,
    n_points,
    zoom,
    -- the quadkey, without the spatial extension, which takes longer to load than a small fleet to map
    array_to_string(
        list_transform(
            range(1, zoom + 1),
            lambda depth: (
                ((cell_x >> ($fine_zoom - depth::INTEGER)) & 1)
                + 2 * ((cell_y >> ($fine_zoom - depth::INTEGER)) & 1)
            )
        ),
        ''
    ) AS tile
FROM levels
WHERE n_in_tile <= $batch_rows OR zoom = $fine_zoom
QUALIFY row_number() OVER (PARTITION BY run_id, cell_x, cell_y ORDER BY zoom) = 1
