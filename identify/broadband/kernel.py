"""The compiled recurrence: one oscillator with a feedback of declared terms, and sensitivities.

In scaled variables (time in 1/W, output in its standard deviation)

    η'' = F = Σ_i θ_i η^{a_i} η'^{b_i} w^{c_i} + μ tanh(η'/s)

is integrated with the classical Runge–Kutta formula, the input w known at half steps. Beside it
run the forward sensitivities s_i = ∂η/∂θ_i of the same discrete recurrence,

    s_i'' = F_η s_i + F_η' s_i' + ∂F/∂θ_i,

one row for each coefficient, for μ and s, and for each parameter of the input's path, whose
∂F/∂θ is F_w ∂w/∂θ. They are exact derivatives of the computed output up to Runge–Kutta's own error
in the variational equation, so that Gauss–Newton needs no differences.
"""

import math

import numba
import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

MAX_POWER = 7


# NaN and infinity keep their meaning (no `nnan`, `ninf`): a diverging trial must be seen.
@numba.njit(cache=True, error_model="numpy", fastmath={"contract", "reassoc", "arcp", "nsz"})
def _integrate(w, dw, theta, powers, mu, threshold, h, derivatives):  # type: ignore[no-untyped-def]
    n, m = theta.size, dw.shape[0]
    friction = 2 if threshold != 0 else 0
    rows = n + friction + m if derivatives else 0
    phi = np.zeros(n + friction + m)
    steps = (w.size - 1) // 2
    out = np.zeros(steps + 1)
    sens = np.zeros((steps + 1, rows))
    y, v = 0.0, 0.0
    sy, sv = np.zeros(rows), np.zeros(rows)
    zy, zv = np.zeros(rows), np.zeros(rows)
    ay, av = np.zeros(rows), np.zeros(rows)
    top = powers.max()
    py, pv, pw = np.ones(MAX_POWER + 1), np.ones(MAX_POWER + 1), np.ones(MAX_POWER + 1)
    for step in range(steps):
        ky, kv = 0.0, 0.0
        total_y, total_v = 0.0, 0.0
        for i in range(rows):
            ay[i] = 0.0
            av[i] = 0.0
            zy[i] = sy[i]
            zv[i] = sv[i]
        for stage in range(4):
            at = 2 * step + (stage + 1) // 2
            if stage == 0:
                c = 0.0
            elif stage == 3:
                c = h
            else:
                c = 0.5 * h
            position, speed, drive = y + c * ky, v + c * kv, w[at]
            for p in range(1, top + 1):
                py[p] = py[p - 1] * position
                pv[p] = pv[p - 1] * speed
                pw[p] = pw[p - 1] * drive
            force, force_y, force_v, force_w = 0.0, 0.0, 0.0, 0.0
            for i in range(n):
                a, b, d = powers[i, 0], powers[i, 1], powers[i, 2]
                phi[i] = py[a] * pv[b] * pw[d]
                force += theta[i] * phi[i]
                if a > 0:
                    force_y += theta[i] * a * py[a - 1] * pv[b] * pw[d]
                if b > 0:
                    force_v += theta[i] * b * py[a] * pv[b - 1] * pw[d]
                if d > 0:
                    force_w += theta[i] * d * py[a] * pv[b] * pw[d - 1]
            if friction:
                t = math.tanh(speed / threshold)
                slope = (1 - t * t) / threshold
                phi[n] = t
                phi[n + 1] = -mu * slope * speed / threshold
                force += mu * t
                force_v += mu * slope
            for j in range(m):
                phi[n + friction + j] = force_w * dw[j, at]
            weight = 1.0 if stage == 0 or stage == 3 else 2.0
            nxt = 0.5 * h if stage < 2 else h
            for i in range(rows):
                dy = zv[i]
                dv = phi[i] + force_y * zy[i] + force_v * zv[i]
                ay[i] += weight * dy
                av[i] += weight * dv
                zy[i] = sy[i] + nxt * dy
                zv[i] = sv[i] + nxt * dv
            ky, kv = speed, force
            total_y += weight * ky
            total_v += weight * kv
        y += h / 6 * total_y
        v += h / 6 * total_v
        out[step + 1] = y
        for i in range(rows):
            sy[i] += h / 6 * ay[i]
            sv[i] += h / 6 * av[i]
            sens[step + 1, i] = sy[i]
        if not math.isfinite(y) or abs(y) > 1e6:
            out[step + 1 :] = np.nan
            break
    return out, sens


def integrate(
    w: FloatArray,
    input_slopes: FloatArray,
    theta: FloatArray,
    powers: IntArray,
    mu: float,
    threshold: float,
    h: float,
    *,
    derivatives: bool = True,
) -> tuple[FloatArray, FloatArray]:
    """Integrate from rest; returns η, shape (steps + 1,), and ∂η/∂θ, shape (steps + 1, rows).

    `w` has 2·steps + 1 samples, at half steps of `h`; `input_slopes` (m, 2·steps + 1) is ∂w by the
    input path's parameters. `threshold` 0 leaves the friction term out; rows are the coefficients,
    then (if any) μ and s, then the input path's; none without
    `derivatives`. NaN from where the solution leaves |η| ≤ 1e6.
    """
    out, sens = _integrate(w, input_slopes, theta, powers, mu, threshold, h, derivatives)
    return np.asarray(out), np.asarray(sens)
