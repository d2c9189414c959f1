"""The compiled loop: ETDRK4 steps of the assembled system (see `etd`), one output row a stride.

Nothing here knows of tubes. Scalars seen by the nonlinear functions are projections of the state;
a delayed flame reads cubic Hermite interpolation of its own stored past, exact to O(h⁴), which
needs delay ≥ h so that no stage looks at the future.

Each step multiplies one matrix by the state: e^{Ah} and, below it, the rows of `ROWS`. Columns are
contiguous and padded to whole vectors, so that the compiler turns the inner loop into SIMD.
"""

import math

import numba

from simulated_rig.statespace import FloatArray

Coefficients = tuple[float, float, float, float, float, float]
DIRECT, TANH, DEAD_ZONE, PLAY = range(4)
#: Rows after the n of the state: z now, at half and at full step; z' ; u_L now, half, full.
Z, Z_HALF, Z_FULL, Z_RATE, LOSS, LOSS_HALF, LOSS_FULL = range(7)
ROWS = 7


@numba.njit(cache=True)
def preformed(kind: int, width: float, z: float, play: float) -> float:
    """The argument of the polynomial."""
    if kind == DIRECT:
        return z
    if kind == TANH:
        return width * math.tanh(z / width)
    if kind == DEAD_ZONE:
        return z - width if z > width else (z + width if z < -width else 0.0)
    return min(max(play, z - width), z + width)


@numba.njit(cache=True)
def preformed_slope(kind: int, width: float, z: float, play: float) -> float:
    """Its derivative by z; `play` is the state that `preformed` has just returned."""
    if kind == DIRECT:
        return 1.0
    if kind == TANH:
        return 1.0 - math.tanh(z / width) ** 2
    if kind == DEAD_ZONE:
        return 1.0 if abs(z) > width else 0.0
    return 1.0 if abs(z - play) >= width * (1.0 - 1e-9) else 0.0  # carried along, to rounding


@numba.njit(cache=True)
def polynomial(c: Coefficients, s: float) -> float:
    """c₀ + c₁ s + … + c₅ s⁵ by Estrin's scheme: half the latency of Horner's."""
    t = s * s
    return (c[0] + c[1] * s) + t * ((c[2] + c[3] * s) + t * (c[4] + c[5] * s))


@numba.njit(cache=True)
def polynomial_slope(c: Coefficients, s: float) -> float:
    """Derivative of `polynomial` by s."""
    t = s * s
    return (c[1] + 2 * c[2] * s) + t * ((3 * c[3] + 4 * c[4] * s) + t * (5 * c[5]))


@numba.njit(cache=True)
def past(
    ring: FloatArray, slope: FloatArray, mask: int, h: float, place: float
) -> tuple[float, float]:
    """Hermite interpolation of the stored z at `place` (in steps): value and time derivative."""
    node = math.floor(place)
    t = place - node
    i, j = node & mask, (node + 1) & mask
    z0, z1, d0, d1 = ring[i], ring[j], h * slope[i], h * slope[j]
    gap = z1 - z0
    value = z0 + t * (d0 + t * ((3 * gap - 2 * d0 - d1) + t * (d0 + d1 - 2 * gap)))
    rate = (d0 + t * (2 * (3 * gap - 2 * d0 - d1) + 3 * t * (d0 + d1 - 2 * gap))) / h
    return value, rate


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def propagate(
    x: FloatArray,
    acc: FloatArray,
    memory: FloatArray,
    ring: FloatArray,
    slope: FloatArray,
    first: int,
    h: float,
    matrix: FloatArray,
    beta: FloatArray,
    alpha: FloatArray,
    alpha_half: FloatArray,
    rate_row: FloatArray,
    rate_b: FloatArray,
    velocity: FloatArray,
    direct: FloatArray,
    kind: int,
    width: float,
    c: FloatArray,
    loss2: float,
    loss3: float,
    delay: float,
    drive: FloatArray,
    noise: FloatArray,
    gain: FloatArray,
    stride: int,
    out: FloatArray,
) -> None:
    """Advance `x` (n,) in place by ``out.shape[0] * stride`` steps, the first numbered `first`.

    `matrix` (n, padded) holds columns of e^{Ah} and of the rows; `beta` (12, n padded) the
    weights, channel by channel. `drive` holds the volts at half steps (2 · steps + 1); `noise`
    and `gain` one value a step, or are empty; `memory[0]` is the play's state; `ring`, `slope`
    the delayed flame's past (length a power of two, unused for delay = 0); `delay` is in steps.
    `direct` (2 + m) holds the shares of f in loss, velocity and f' in the microphones. `out`
    (frames, 2 + m): velocity, z, microphones.
    """
    n = x.size
    padded = matrix.shape[1]
    short = beta.shape[1]
    microphones = out.shape[1] - 2
    lossy = loss2 != 0.0 or loss3 != 0.0
    noisy = noise.size > 0
    modulated = gain.size > 0
    delayed = delay > 0.0
    mask = ring.size - 1
    step = 0
    place = 0.0
    play = memory[0]
    rate = 0.0
    w = 0.0
    g = 1.0
    l0 = la = lb = lc = 0.0
    # Locals, because the compiler must assume that stores to arrays change what it has read.
    az_f, az_l, az_u, az_w = alpha[0, 0], alpha[0, 1], alpha[0, 2], alpha[0, 3]
    hz_f, hz_l, hz_u, hz_w = (
        alpha_half[0, 0],
        alpha_half[0, 1],
        alpha_half[0, 2],
        alpha_half[0, 3] + alpha[0, 3],
    )
    poly = (c[0], c[1], c[2], c[3], c[4], c[5])
    for frame in range(out.shape[0]):
        for sub in range(stride):
            u0, uh, u1 = drive[2 * step], drive[2 * step + 1], drive[2 * step + 2]
            if noisy:
                w = noise[step]
            if modulated:
                g = gain[step]
            for i in range(padded):
                acc[i] = matrix[0, i] * x[0]
            for j in range(1, n):
                xj = x[j]
                for i in range(padded):
                    acc[i] += matrix[j, i] * xj
            z, zh, zf = acc[n + Z], acc[n + Z_HALF], acc[n + Z_FULL]
            seen = z
            if delayed:
                place = first + step - delay
                seen, rate = past(ring, slope, mask, h, place)
            if kind == PLAY:
                play = preformed(kind, width, seen, play)
            s = preformed(kind, width, seen, play)
            f0 = g * polynomial(poly, s)
            if lossy:
                l = acc[n + LOSS] + direct[0] * f0
                l0 = loss2 * abs(l) * l + loss3 * l * l * l
            if delayed or sub == 0:
                zrate = acc[n + Z_RATE] + (
                    rate_b[0, 0] * f0 + rate_b[0, 1] * l0 + rate_b[0, 2] * u0 + rate_b[0, 3] * w
                )
                if delayed:
                    ring[(first + step) & mask] = z
                    slope[(first + step) & mask] = zrate
                else:
                    rate = zrate
            if sub == 0:
                y = direct[1] * f0
                for j in range(n):
                    y += velocity[j] * x[j]
                out[frame, 0] = y
                out[frame, 1] = z
                tilt = polynomial_slope(poly, s) * preformed_slope(kind, width, seen, play)
                for m in range(microphones):
                    p = direct[2 + m] * g * tilt * rate + (
                        rate_b[1 + m, 0] * f0
                        + rate_b[1 + m, 1] * l0
                        + rate_b[1 + m, 2] * u0
                        + rate_b[1 + m, 3] * w
                    )
                    for j in range(n):
                        p += rate_row[1 + m, j] * x[j]
                    out[frame, 2 + m] = p

            # Stages a (g from the start), b (from a), c (from b, at the end); see `etd`.
            if delayed:
                seen, rate = past(ring, slope, mask, h, place + 0.5)
            else:
                seen = zh + (az_f * f0 + az_l * l0 + az_u * u0 + az_w * w)
            fa = g * polynomial(poly, preformed(kind, width, seen, play))
            if lossy:
                l = acc[n + LOSS_HALF] + direct[0] * fa
                l += alpha[1, 0] * f0 + alpha[1, 1] * l0 + alpha[1, 2] * u0 + alpha[1, 3] * w
                la = loss2 * abs(l) * l + loss3 * l * l * l

            fb = fa
            if not delayed:
                seen = zh + (az_f * fa + az_l * la + az_u * uh + az_w * w)
                fb = g * polynomial(poly, preformed(kind, width, seen, play))
            if lossy:
                l = acc[n + LOSS_HALF] + direct[0] * fb
                l += alpha[1, 0] * fa + alpha[1, 1] * la + alpha[1, 2] * uh + alpha[1, 3] * w
                lb = loss2 * abs(l) * l + loss3 * l * l * l

            df, dl, du = 2 * fb - f0, 2 * lb - l0, 2 * uh - u0
            if delayed:
                seen, rate = past(ring, slope, mask, h, place + 1.0)
            else:
                seen = (
                    zf
                    + (hz_f * f0 + az_f * df)
                    + (hz_l * l0 + az_l * dl)
                    + (hz_u * u0 + az_u * du)
                    + hz_w * w
                )
            fc = g * polynomial(poly, preformed(kind, width, seen, play))
            if lossy:
                l = (
                    (acc[n + LOSS_FULL] + direct[0] * fc)
                    + (alpha_half[1, 0] * f0 + alpha[1, 0] * df)
                    + (alpha_half[1, 1] * l0 + alpha[1, 1] * dl)
                    + (alpha_half[1, 2] * u0 + alpha[1, 2] * du)
                    + (alpha_half[1, 3] + alpha[1, 3]) * w
                )
                lc = loss2 * abs(l) * l + loss3 * l * l * l

            fm, um = fa + fb, 2 * uh
            for i in range(short):
                acc[i] += (
                    (beta[0, i] * f0 + beta[1, i] * fm + beta[2, i] * fc)
                    + (beta[6, i] * u0 + beta[7, i] * um)
                    + beta[8, i] * u1
                )
            if lossy:
                lm = la + lb
                for i in range(short):
                    acc[i] += beta[3, i] * l0 + beta[4, i] * lm + beta[5, i] * lc
            if noisy:
                for i in range(short):
                    acc[i] += (beta[9, i] + 2 * beta[10, i] + beta[11, i]) * w
            for i in range(n):
                x[i] = acc[i]
            step += 1
    memory[0] = play
