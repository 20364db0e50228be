-- why: Which reference signs could no pass have seen? They are missed by the drives, not by the method
-- reads: reference
-- params: none
-- writes: run_id VARCHAR, sign_id VARCHAR, sign_class VARCHAR, facing_deg DOUBLE, lon DOUBLE, lat DOUBLE
SELECT
    run_id,
    sign_id,
    sign_class,
    facing_deg,
    bbox.xmin AS lon,
    bbox.ymin AS lat
FROM reference
WHERE n_passes_in_view = 0
ORDER BY run_id, sign_id
