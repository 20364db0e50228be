-- why: what each track in information form says once its own place is solved for: with N in blocks (p: east, north;
--      b: range bias, bearing bias), q = N_pp^-1 r_p and K = N_pp^-1 N_pb place it at q - K b from its origin, and
--      S = N_bb - N_bp K and u = r_b - N_bp q are what it knows about the bias. A track without the form, or whose form
--      does not fix a place, has no q
-- reads: @aggregate/usable, @aggregate/fleet
-- params: none
-- writes: run_id VARCHAR, vehicle_id VARCHAR, pass_id VARCHAR, track_id BIGINT, sign_class VARCHAR, lon DOUBLE,
--         lat DOUBLE, n_frames BIGINT, var_m2 DOUBLE, class_confidence DOUBLE, t_first_us BIGINT, t_last_us BIGINT,
--         info_lon DOUBLE, info_lat DOUBLE, info_s0 DOUBLE, info_dof DOUBLE, q_e DOUBLE, q_n DOUBLE, k_er DOUBLE,
--         k_et DOUBLE, k_nr DOUBLE, k_nt DOUBLE, inv_ee DOUBLE, inv_en DOUBLE, inv_nn DOUBLE, s_rr DOUBLE, s_rt DOUBLE,
--         s_tt DOUBLE, u_r DOUBLE, u_t DOUBLE
WITH forms AS (
    SELECT
        * EXCLUDE (info_matrix, info_vector),
        info_matrix[1] AS ee,
        info_matrix[2] AS en,
        info_matrix[3] AS er,
        info_matrix[4] AS et,
        info_matrix[5] AS nn,
        info_matrix[6] AS nr,
        info_matrix[7] AS nt,
        info_matrix[8] AS rr,
        info_matrix[9] AS rt,
        info_matrix[10] AS tt,
        info_vector[1] AS r_e,
        info_vector[2] AS r_n,
        info_vector[3] AS r_r,
        info_vector[4] AS r_t,
        -- all of it is there and finite, and N_pp has two axes
        isfinite(info_lon + abs(info_lat) + list_sum(info_matrix) + list_sum(info_vector))
        AND len(list_filter(info_matrix, lambda x: x IS NULL)) + len(list_filter(info_vector, lambda x: x IS NULL)) = 0
        AND abs(info_lat) <= 85.04 AND ee > 0 AND nn > 0 AND ee * nn - en * en > 1e-9 * ee * nn AS is_fixed
    FROM usable
    SEMI JOIN fleet USING (run_id, vehicle_id)
),
inverses AS (
    SELECT
        *,
        CASE WHEN is_fixed THEN nn / (ee * nn - en * en) END AS inv_ee,
        CASE WHEN is_fixed THEN -en / (ee * nn - en * en) END AS inv_en,
        CASE WHEN is_fixed THEN ee / (ee * nn - en * en) END AS inv_nn
    FROM forms
),
places AS (
    SELECT
        *,
        inv_ee * r_e + inv_en * r_n AS q_e,
        inv_en * r_e + inv_nn * r_n AS q_n,
        inv_ee * er + inv_en * nr AS k_er,
        inv_ee * et + inv_en * nt AS k_et,
        inv_en * er + inv_nn * nr AS k_nr,
        inv_en * et + inv_nn * nt AS k_nt
    FROM inverses
)
SELECT
    * EXCLUDE (ee, en, er, et, nn, nr, nt, rr, rt, tt, r_e, r_n, r_r, r_t, is_fixed, inv_ee, inv_en, inv_nn,
        q_e, q_n, k_er, k_et, k_nr, k_nt),
    q_e,
    q_n,
    k_er,
    k_et,
    k_nr,
    k_nt,
    inv_ee,
    inv_en,
    inv_nn,
    rr - er * k_er - nr * k_nr AS s_rr,
    rt - er * k_et - nr * k_nt AS s_rt,
    tt - et * k_et - nt * k_nt AS s_tt,
    r_r - er * q_e - nr * q_n AS u_r,
    r_t - et * q_e - nt * q_n AS u_t
FROM places
