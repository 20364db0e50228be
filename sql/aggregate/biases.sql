-- why: range and bearing bias of every pass from its own tracks, b = (P^-1 + sum S)^-1 sum u, and its covariance. Tracks
--      of under three frames, or whose residual is beyond five sigmas of chi-squared, have no say: they may be ghosts,
--      or two signs in one. Where half the tracks of a pass fit worse than declared, its sigmas are scaled up to them.
--      P is the car's own declaration or else a weak one. Sums go in the order of the tracks: the same bits each time
-- reads: @aggregate/solved, passes AS driven
-- params: $range_bias_sigma_m (double, metres, of cars that declare none; 5 if not given),
--         $bearing_bias_sigma_deg (double, degrees, of cars that declare none; 5 if not given)
-- writes: run_id VARCHAR, pass_id VARCHAR, n_tracks BIGINT, scale DOUBLE, range_bias_m DOUBLE, bearing_bias_rad DOUBLE,
--         var_rr DOUBLE, cov_rt DOUBLE, var_tt DOUBLE
WITH scales AS (
    SELECT
        run_id,
        pass_id,
        greatest(coalesce(median(info_s0 / info_dof) FILTER (WHERE info_dof > 0 AND isfinite(info_s0)), 1), 1) AS scale
    FROM solved
    GROUP BY run_id, pass_id
),
sums AS (
    SELECT
        run_id,
        pass_id,
        count(*) AS n_tracks,
        sum(s_rr ORDER BY track_id) AS s_rr,
        sum(s_rt ORDER BY track_id) AS s_rt,
        sum(s_tt ORDER BY track_id) AS s_tt,
        sum(u_r ORDER BY track_id) AS u_r,
        sum(u_t ORDER BY track_id) AS u_t
    FROM solved
    JOIN scales USING (run_id, pass_id)
    WHERE q_e IS NOT NULL
        AND n_frames >= 3
        AND coalesce(info_s0 <= scale * (info_dof + 5 * sqrt(2 * greatest(info_dof, 1))), TRUE)
    GROUP BY run_id, pass_id
),
posteriors AS ( -- A = P^-1 + sum S / scale; a bias that the car knows to be none (sigma 0) stays none
    SELECT
        scales.run_id,
        scales.pass_id,
        coalesce(n_tracks, 0) AS n_tracks,
        scale,
        coalesce(s_rr, 0) / scale
        + 1 / greatest(coalesce(range_bias_sigma_m, $range_bias_sigma_m), 1e-6) ** 2 AS a_rr,
        coalesce(s_rt, 0) / scale AS a_rt,
        coalesce(s_tt, 0) / scale
        + 1 / greatest(radians(coalesce(bearing_bias_sigma_deg, $bearing_bias_sigma_deg)), 1e-9) ** 2 AS a_tt,
        coalesce(u_r, 0) / scale AS u_r,
        coalesce(u_t, 0) / scale AS u_t
    FROM scales
    LEFT JOIN sums USING (run_id, pass_id)
    LEFT JOIN driven USING (run_id, pass_id)
)
SELECT
    run_id,
    pass_id,
    n_tracks,
    scale,
    (a_tt * u_r - a_rt * u_t) / (a_rr * a_tt - a_rt * a_rt) AS range_bias_m,
    (a_rr * u_t - a_rt * u_r) / (a_rr * a_tt - a_rt * a_rt) AS bearing_bias_rad,
    a_tt / (a_rr * a_tt - a_rt * a_rt) AS var_rr,
    -a_rt / (a_rr * a_tt - a_rt * a_rt) AS cov_rt,
    a_rr / (a_rr * a_tt - a_rt * a_rt) AS var_tt
FROM posteriors
ORDER BY run_id, pass_id
