-- why: every detection in the tile that owns it and, as halo, in every other tile within $halo_m of it
-- reads: @aggregate/points, @aggregate/passes, @aggregate/classes, @tiles/assign
-- params: $zoom (integer, tile zoom), $halo_m (double, metres)
-- writes: batch BIGINT, tile_code BIGINT, is_owned BOOLEAN, pass_code BIGINT, pass_hash UBIGINT, track_id BIGINT,
--         class_code BIGINT, lon DOUBLE, lat DOUBLE, n_frames BIGINT, spread_m2 DOUBLE, class_confidence DOUBLE,
--         t_first_us BIGINT, t_last_us BIGINT
WITH coded AS (
    SELECT
        points.* EXCLUDE (pass_id, sign_class),
        pass_code,
        pass_hash,
        class_code,
        ST_QuadKey(lon, lat, $zoom) AS home,
        -- a degree is at least 110,574 m of latitude, and 111,319 m of longitude times the cosine of the latitude
        $halo_m / 110500 AS reach_lat_deg,
        $halo_m / (111300 * cos(radians(abs(lat) + $halo_m / 110500))) AS reach_lon_deg
    FROM points
    JOIN passes USING (run_id, pass_id)
    JOIN classes USING (sign_class)
),
-- Most detections are far from a border: the box around them begins and ends in one tile.
near_border AS (
    SELECT
        *,
        -- samples across the box no farther apart than a tile is wide, so that no tile in it is missed
        2 + floor(2.02 * reach_lon_deg / (360.0 / (1 << $zoom)))::BIGINT AS n_samples
    FROM coded
    -- longitudes are wrapped by hand: ST_QuadKey wraps those above 180, but not those below -180
    WHERE ST_QuadKey((lon - reach_lon_deg + 540) % 360 - 180, greatest(lat - reach_lat_deg, -85.051), $zoom)
        <> ST_QuadKey((lon + reach_lon_deg + 540) % 360 - 180, least(lat + reach_lat_deg, 85.051), $zoom)
),
samples AS (
    SELECT
        near_border.*,
        (lon + reach_lon_deg * (2.0 * i / (n_samples - 1) - 1) + 540) % 360 - 180 AS sample_lon,
        lat + reach_lat_deg * (2.0 * j / (n_samples - 1) - 1) AS sample_lat
    FROM near_border, unnest(range(n_samples)) AS columns_(i), unnest(range(n_samples)) AS rows_(j)
),
placed AS (
    SELECT * EXCLUDE (reach_lat_deg, reach_lon_deg), home AS tile FROM coded
    UNION ALL
    SELECT DISTINCT
        * EXCLUDE (reach_lat_deg, reach_lon_deg, n_samples, sample_lon, sample_lat),
        ST_QuadKey(sample_lon, least(greatest(sample_lat, -85.051), 85.051), $zoom) AS tile
    FROM samples
    WHERE tile <> home
)
SELECT
    batch,
    tile_code,
    tile = home AS is_owned,
    pass_code,
    pass_hash,
    track_id,
    class_code,
    lon,
    lat,
    n_frames,
    spread_m2,
    class_confidence,
    t_first_us,
    t_last_us
FROM placed
JOIN assign USING (run_id, tile) -- tiles that own nothing have nothing to cluster
