-- why: the box that detections must lie in, one row; without a stated area the table has none. West beyond east is a box
--      across the antimeridian
-- reads: none
-- params: $west (double, degrees; null if not given), $south (double, degrees; null if not given),
--         $east (double, degrees; null if not given), $north (double, degrees; null if not given)
-- writes: west DOUBLE, south DOUBLE, east DOUBLE, north DOUBLE
SELECT
    $west::DOUBLE AS west,
    $south::DOUBLE AS south,
    $east::DOUBLE AS east,
    $north::DOUBLE AS north
WHERE west IS NOT NULL
