"""Newton's method on the harmonic balance where every characteristic is a `Polynomial`, compiled.

The equations are those of `identify.balance`, for rows (runs of several parameter vectors) that
know nothing of each other, so each row takes its own steps and stops by itself. N̂ is sampled as
there; its Jacobian needs only the slope's Fourier coefficients S_m = ⟨N′ e^{−jmτ}⟩,

    ∂N̂_k/∂Re v_l = S_{k−l} + S_{k+l},      ∂N̂_k/∂Im v_l = j (S_{k−l} − S_{k+l}),

so that one of K harmonics costs about as much as the linear solve. In a free run P and Q move with
the unknown ω, to first order about where they were assembled; the caller assembles them again
where that ended, until nothing moves.
"""

import numba
import numpy as np


# NaN and infinity keep their meaning: a row that diverges must be seen to.
@numba.njit(cache=True, error_model="numpy")
def _eliminate(A, b, n):  # type: ignore[no-untyped-def]
    """Solve A x = b in place by Gaussian elimination with row pivoting; False where singular."""
    for i in range(n):
        best, top = i, abs(A[i, i])
        for r in range(i + 1, n):
            if abs(A[r, i]) > top:
                best, top = r, abs(A[r, i])
        if not top > 0.0:
            return False
        if best != i:
            for c in range(i, n):
                A[i, c], A[best, c] = A[best, c], A[i, c]
            b[i], b[best] = b[best], b[i]
        inverse = 1.0 / A[i, i]
        for r in range(i + 1, n):
            factor = A[r, i] * inverse
            if factor != 0.0:
                for c in range(i + 1, n):
                    A[r, c] -= factor * A[i, c]
                b[r] -= factor * b[i]
    for i in range(n - 1, -1, -1):
        total = b[i]
        for c in range(i + 1, n):
            total -= A[i, c] * b[c]
        b[i] = total / A[i, i]
    return True


@numba.njit(cache=True, error_model="numpy")
def _sample(curve, v, cosines, sines, F, S):  # type: ignore[no-untyped-def]
    """N̂ (K,) and the slope's coefficients S_0 … S_2K of one row; tables are (T, 2K + 1)."""
    K, T = v.size, cosines.shape[0]
    for k in range(K):
        F[k] = 0.0
    for m in range(2 * K + 1):
        S[m] = 0.0
    for t in range(T):
        x = 0.0
        for k in range(K):
            x += v[k].real * cosines[t, k + 1] - v[k].imag * sines[t, k + 1]
        size = abs(x)
        total, slope = 0.0, 0.0
        for d in range(curve.size - 1, 0, -1):
            total = total * x + curve[d]
            slope = slope * x + d * curve[d]
        force = (total + curve[0] * size) * x * 2.0 / T
        slope = (slope + 2.0 * curve[0] * size) / T
        for k in range(K):
            F[k] += complex(force * cosines[t, k + 1], -force * sines[t, k + 1])
        for m in range(2 * K + 1):
            S[m] += complex(slope * cosines[t, m], -slope * sines[t, m])


@numba.njit(cache=True, error_model="numpy")
def slopes(curves, v, cosines, sines):  # type: ignore[no-untyped-def]
    """∂N̂/∂x of all loops and rows, (loops, rows, K, 2K), at inputs `v` (loops, rows, K)."""
    loops, rows, K = v.shape
    out = np.empty((loops, rows, K, 2 * K), dtype=np.complex128)
    F = np.empty(K, dtype=np.complex128)
    S = np.empty(2 * K + 1, dtype=np.complex128)
    for b in range(loops):
        for r in range(rows):
            _sample(curves[b, r], v[b, r], cosines, sines, F, S)
            for k in range(K):
                for l in range(K):
                    gap = S[k - l] if k >= l else np.conj(S[l - k])
                    far = S[k + l + 2]
                    out[b, r, k, l] = gap + far
                    out[b, r, k, l + K] = 1j * (gap - far)
    return out


@numba.njit(cache=True, error_model="numpy")
def add_held(slope, followed, to_time, to_harmonics, out):  # type: ignore[no-untyped-def]
    """Add to ∂N̂/∂x, `out` (rows, K, 2K), what comes of time samples that follow the input of
    another sample; `slope` and `followed` (rows, T), matrices as of `identify.balance`."""
    rows, T = slope.shape
    K = out.shape[1]
    total = np.zeros(K, dtype=np.complex128)
    for r in range(rows):
        source = -1  # what is held is held for a while: summed up until it lets go
        for t in range(T + 1):
            now = followed[r, t] if t < T and followed[r, t] != t else -1
            if now != source:
                if source >= 0:
                    for k in range(K):
                        for l in range(2 * K):
                            out[r, k, l] += total[k] * to_time[source, l]
                        total[k] = 0.0
                source = now
            if now >= 0:
                for k in range(K):
                    total[k] += to_harmonics[k, t] * slope[r, t]


@numba.njit(cache=True, error_model="numpy")
def newton(P, Q, dP, dQ, curves, v, omega, cosines, sines, free, limit, tolerance):  # type: ignore[no-untyped-def]
    """Steps of every row from `v` (loops, rows, K), changed in place, as `omega` (rows,) is
    where `free` (rows,).

    P (loops, loops, rows, K), Q (loops, rows, K) and their derivatives by ω; `curves` (loops,
    rows, degree + 1) as `Polynomial.table` gives them. Returns the relative residual of each row
    (infinite where it is no number), how many steps it took, of `limit` (rows,) at most, and N̂
    (loops, rows, K).
    """
    loops, rows, K = v.shape
    n = 2 * K * loops
    error = np.full(rows, np.inf)
    taken = np.zeros(rows, dtype=np.int64)
    forces = np.empty((loops, rows, K), dtype=np.complex128)
    S = np.empty((loops, 2 * K + 1), dtype=np.complex128)
    R = np.empty((loops, K), dtype=np.complex128)
    J, step = np.empty((n, n)), np.empty(n)
    for r in range(rows):
        begin = omega[r]
        for turn in range(limit[r] + 1):
            away = omega[r] - begin
            for b in range(loops):
                _sample(curves[b, r], v[b, r], cosines, sines, forces[b, r], S[b])
            worst, widest = 0.0, 0.0
            for a in range(loops):
                misfit, size = 0.0, 0.0
                for k in range(K):
                    R[a, k] = v[a, r, k] - Q[a, r, k] - away * dQ[a, r, k]
                    for b in range(loops):
                        R[a, k] -= (P[a, b, r, k] + away * dP[a, b, r, k]) * forces[b, r, k]
                    misfit += R[a, k].real ** 2 + R[a, k].imag ** 2
                    size += v[a, r, k].real ** 2 + v[a, r, k].imag ** 2
                size = np.sqrt(size) + 1e-300
                relative = np.sqrt(misfit) / size
                if not relative <= worst:
                    worst = relative
                widest = max(widest, size)
            error[r] = worst if np.isfinite(worst) else np.inf
            if turn == limit[r] or worst < tolerance or not np.isfinite(worst):
                break
            for a in range(loops):
                for b in range(loops):
                    for k in range(K):
                        p = P[a, b, r, k] + away * dP[a, b, r, k]
                        for l in range(K):
                            gap = S[b, k - l] if k >= l else np.conj(S[b, l - k])
                            far = S[b, k + l + 2]
                            by_real, by_imag = -p * (gap + far), -p * (1j * (gap - far))
                            i, j = 2 * K * a + k, 2 * K * b + l
                            J[i, j] = by_real.real
                            J[i + K, j] = by_real.imag
                            J[i, j + K] = by_imag.real
                            J[i + K, j + K] = by_imag.imag
            for i in range(n):
                J[i, i] += 1.0
            for a in range(loops):
                for k in range(K):
                    i = 2 * K * a + k
                    step[i], step[i + K] = R[a, k].real, R[a, k].imag
                    if free[r]:  # Im v_0,1 stays 0: its column is ω's
                        by_omega = -dQ[a, r, k]
                        for b in range(loops):
                            by_omega -= dP[a, b, r, k] * forces[b, r, k]
                        J[i, K], J[i + K, K] = by_omega.real, by_omega.imag
            if not _eliminate(J, step, n):
                error[r] = np.inf
                break
            if free[r]:
                omega[r] -= min(max(step[K], -0.05 * omega[r]), 0.05 * omega[r])
                step[K] = 0.0
            # A full Newton step far outside the orbit's size is a step off the branch: damp it.
            longest = 0.0
            for i in range(n):
                longest = max(longest, abs(step[i]))
            share = min(1.0, 0.5 * widest / max(longest, 1e-300))
            for a in range(loops):
                for k in range(K):
                    i = 2 * K * a + k
                    v[a, r, k] -= share * complex(step[i], step[i + K])
            taken[r] += 1
    return error, taken, forces
