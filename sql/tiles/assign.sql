-- why: the tiles that own detections, with their counts, dealt into batches of neighbouring tiles (quadkeys sort along
--      a space-filling curve); a batch ends before it exceeds $batch_rows, unless one tile alone does
-- reads: @aggregate/points
-- params: $zoom (integer, tile zoom), $batch_rows (integer, detections a batch)
-- writes: run_id VARCHAR, tile VARCHAR, n_points BIGINT, tile_code BIGINT, batch BIGINT
WITH counts AS (
    SELECT
        run_id,
        ST_QuadKey(lon, lat, $zoom) AS tile,
        count(*) AS n_points
    FROM points
    GROUP BY run_id, tile
)
SELECT
    run_id,
    tile,
    n_points,
    row_number() OVER in_order - 1 AS tile_code,
    ((sum(n_points) OVER in_order - 1) // $batch_rows)::BIGINT AS batch
FROM counts
WINDOW in_order AS (ORDER BY run_id, tile ROWS BETWEEN UNBOUNDED PRECEDING AND CURRENT ROW)
ORDER BY tile_code
