-- why: the tiles that read each cell: the one that owns it, without bounds, and those around it, each with the box, in
--      cells, whose detections lie in its halo
-- reads: @tiles/leaves, @tiles/assign
-- params: $fine_zoom (integer, zoom of the cells; 18 if not given),
--         $halo_m (double, metres; 8.008 if not given),
--         $n_around (integer, cells to look around; 1 if not given)
-- writes: run_id VARCHAR, cell_x INTEGER, cell_y INTEGER, tile_code INTEGER, batch INTEGER, is_owned BOOLEAN,
--         west DOUBLE, east DOUBLE, north DOUBLE, south DOUBLE
WITH placed AS (
    SELECT
        leaves.*,
        tile_code,
        batch,
        1 << ($fine_zoom - zoom) AS width,
        -- Nowhere is a radian of latitude shorter than 6,335,000 m, and Web Mercator stretches by the secant of the
        -- latitude in both directions, taken at the edge of the cell that is farther from the equator.
        $halo_m / (2 * pi()) * (1 << $fine_zoom) * cosh(
            pi() * (1 - 2 * (cell_y + (cell_y >= 1 << ($fine_zoom - 1))::INTEGER) / (1 << $fine_zoom))
        ) / (6335000 - 24 * $halo_m) AS reach -- the cosine is above 1/12: what the halo itself adds is within 24 / 2
    FROM leaves
    JOIN assign USING (run_id, tile)
),
neighbours AS MATERIALIZED (
    SELECT
        run_id,
        cell_x,
        cell_y,
        reach,
        tile_code AS own_code,
        step_x,
        (cell_x + step_x + (1 << $fine_zoom)) % (1 << $fine_zoom) AS other_x,
        cell_y + step_y AS other_y
    FROM placed, unnest(range(-$n_around, $n_around + 1)) AS columns_(step_x),
        unnest(range(-$n_around, $n_around + 1)) AS rows_(step_y)
),
seen AS (
    SELECT DISTINCT
        neighbours.run_id,
        neighbours.cell_x,
        neighbours.cell_y,
        neighbours.reach,
        other.tile_code,
        other.batch,
        other.width,
        -- counted from this side of the antimeridian
        neighbours.cell_x + step_x - other.cell_x % other.width AS box_x,
        other.cell_y - other.cell_y % other.width AS box_y
    FROM neighbours
    JOIN placed AS other -- tiles that own nothing have nothing to cluster
        ON other.run_id = neighbours.run_id AND other.cell_x = other_x AND other.cell_y = other_y
    WHERE other.tile_code <> own_code
)
SELECT
    run_id,
    cell_x,
    cell_y,
    tile_code,
    batch,
    TRUE AS is_owned,
    '-inf'::DOUBLE AS west,
    'inf'::DOUBLE AS east,
    '-inf'::DOUBLE AS north,
    'inf'::DOUBLE AS south
FROM placed
UNION ALL
SELECT
    run_id,
    cell_x,
    cell_y,
    tile_code,
    batch,
    FALSE AS is_owned,
    box_x - reach AS west,
    box_x + width + reach AS east,
    box_y - reach AS north,
    box_y + width + reach AS south
FROM seen
