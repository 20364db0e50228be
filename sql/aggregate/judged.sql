-- why: every detection with the reason why it cannot be used, or none: it must be placed, within the area where one is
--      stated, classed and named; ST_QuadKey takes NaN and latitudes beyond Web Mercator without a word
-- reads: detections, @aggregate/area, @aggregate/unlisted
-- params: none
-- writes: reason VARCHAR, run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR,
--         lon DOUBLE, lat DOUBLE, n_frames BIGINT, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT,
--         t_last_us BIGINT, info_lon DOUBLE, info_lat DOUBLE, info_matrix DOUBLE[], info_vector DOUBLE[],
--         info_s0 DOUBLE, info_dof DOUBLE
SELECT
    CASE
        WHEN run_id IS NULL OR vehicle_id IS NULL OR pass_id IS NULL OR track_id IS NULL THEN 'key missing'
        WHEN coalesce(trim(sign_class), '') = '' THEN 'class missing'
        WHEN bbox.xmin IS NULL OR bbox.ymin IS NULL THEN 'position missing'
        WHEN NOT (isfinite(bbox.xmin) AND isfinite(bbox.ymin)) THEN 'position not finite'
        WHEN abs(bbox.xmin) > 180 OR abs(bbox.ymin) > 85.05 THEN 'position out of range'
        WHEN NOT ( -- null, that is not so, where no area is stated
            bbox.ymin BETWEEN area.south AND area.north
            AND CASE
                WHEN area.west <= area.east THEN bbox.xmin BETWEEN area.west AND area.east
                ELSE bbox.xmin >= area.west OR bbox.xmin <= area.east
            END
        ) THEN 'outside the area'
        WHEN sign_class IN (SELECT sign_class FROM unlisted) THEN 'class unknown'
    END AS reason,
    run_id,
    vehicle_id,
    pass_id,
    track_id,
    sign_class,
    bbox.xmin AS lon,
    bbox.ymin AS lat,
    n_frames,
    -- variance of the mean over the frames, an axis; what is missing widens it: a spread counts as 1 m, frames as one
    CASE
        WHEN isfinite(sigma_e_m * sigma_e_m + sigma_n_m * sigma_n_m)
            THEN (sigma_e_m * sigma_e_m + sigma_n_m * sigma_n_m) / 2
        ELSE 1.0
    END / greatest(coalesce(n_frames, 1), 1) AS var_m2,
    class_confidence,
    epoch_us(t_first) AS t_first_us,
    epoch_us(t_last) AS t_last_us,
    info_lon,
    info_lat,
    info_matrix::DOUBLE[] AS info_matrix,
    info_vector::DOUBLE[] AS info_vector,
    info_s0,
    info_dof
FROM detections
LEFT JOIN area ON TRUE
