-- why: the box that detections must lie in, one row; without a stated area the table has none. West beyond east is a box
--      across the antimeridian
-- reads: none
-- params: $west (double, degrees), $south (double, degrees), $east (double, degrees), $north (double, degrees)
-- writes: west DOUBLE, south DOUBLE, east DOUBLE, north DOUBLE
SELECT
    $west AS west,
    $south AS south,
    $east AS east,
    $north AS north
