-- why: detections a cell of the finest grid; column and row are those of ST_QuadKey, as integers because a text a
--      detection is slow. Of one plain file `geofleet/tables/plain.py` says the same, and a test demands the same rows
-- reads: @aggregate/chosen
-- params: $fine_zoom (integer, zoom of the cells; 18 if not given)
-- writes: run_id VARCHAR, cell_x INTEGER, cell_y INTEGER, n_points BIGINT
SELECT
    run_id,
    floor((lon + 180) / 360 * (1 << $fine_zoom))::INTEGER % (1 << $fine_zoom) AS cell_x, -- 180 is -180
    floor(
        (0.5 - ln((1 + sin(radians(lat))) / (1 - sin(radians(lat)))) / (4 * pi())) * (1 << $fine_zoom)
    )::INTEGER AS cell_y,
    count(*) AS n_points
FROM chosen
GROUP BY run_id, cell_x, cell_y
