-- why: the tiles that own detections, with their counts, dealt into batches of neighbouring tiles (quadkeys sort along
--      a space-filling curve); a batch ends before it exceeds $batch_rows by a tile
-- reads: @tiles/leaves
-- params: $batch_rows (integer, detections a batch; 100000 if not given)
-- writes: run_id VARCHAR, tile VARCHAR, n_points BIGINT, tile_code INTEGER, batch INTEGER
WITH tiles AS (
    SELECT
        run_id,
        tile,
        sum(n_points)::BIGINT AS n_points
    FROM leaves
    GROUP BY run_id, tile
)
SELECT
    run_id,
    tile,
    n_points,
    (row_number() OVER in_order - 1)::INTEGER AS tile_code,
    ((sum(n_points) OVER in_order - 1) // $batch_rows)::INTEGER AS batch
FROM tiles
WINDOW in_order AS (ORDER BY run_id, tile ROWS BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW)
ORDER BY tile_code
