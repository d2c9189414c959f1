"""The compiled loop for the plain case: polynomial flame, drive, nothing else; unrolled by order.

The same scheme as `kernel.propagate`, without delay, preform, open-end loss, turbulence or
modulation. The state is a tuple, so that it lives in registers; for each order the products are
written out by the overloads below at compile time, term by term, as one would by hand. Each order
compiles once (some seconds) and is cached on disk; `ORDERS` keeps that to the common ones.
"""

from collections.abc import Callable
from typing import Any

import numba
from numba.extending import overload

from simulated_rig.kernel import polynomial, polynomial_slope
from simulated_rig.statespace import FloatArray

ORDERS = (3, 5, 7)  # one to three modes behind a first-order flame
State = tuple[float, ...]


def stepped(matrix: FloatArray, x: State) -> State:
    """e^{Ah} x, then z now, at half and at full step, then z' (columns of `matrix`)."""
    raise NotImplementedError


def pushed(beta: FloatArray, y: State, x: State, f: State, u: State) -> State:
    """y plus the weights of the flame's values `f` and the drive's `u`, as long as x."""
    raise NotImplementedError


def row_times(rows: FloatArray, k: int, x: State) -> float:
    """rows[k] · x."""
    raise NotImplementedError


def loaded(values: FloatArray, x: State) -> State:
    """The first len(x) of `values` as a tuple."""
    raise NotImplementedError


def stored(values: FloatArray, x: State) -> None:
    """The reverse of `loaded`."""
    raise NotImplementedError


def _sum(terms: list[str]) -> str:
    """Terms added pairwise: half the latency of a chain."""
    while len(terms) > 1:
        terms = [" + ".join(terms[i : i + 2]) for i in range(0, len(terms), 2)]
        terms = [f"({term})" for term in terms]
    return terms[0]


def _function(arguments: str, body: str) -> Callable[..., Any]:
    space: dict[str, Any] = {}
    exec(f"def made({arguments}):\n    {body}\n", space)
    made: Callable[..., Any] = space["made"]
    return made


@overload(stepped, strict=False)
def _stepped(matrix: Any, x: Any) -> Callable[..., Any]:
    n = x.count
    rows = [_sum([f"matrix[{j}, {i}] * x[{j}]" for j in range(n)]) for i in range(n + 4)]
    return _function("matrix, x", f"return ({', '.join(rows)})")


@overload(pushed, strict=False)
def _pushed(beta: Any, y: Any, x: Any, f: Any, u: Any) -> Callable[..., Any]:
    terms = []
    for i in range(x.count):
        weights = [f"beta[{c}, {i}] * f[{c}]" for c in range(3)]
        weights += [f"beta[{6 + c}, {i}] * u[{c}]" for c in range(3)]
        terms.append(f"y[{i}] + {_sum(weights)}")
    return _function("beta, y, x, f, u", f"return ({', '.join(terms)},)")


@overload(row_times, strict=False)
def _row_times(rows: Any, k: Any, x: Any) -> Callable[..., Any]:
    return _function(
        "rows, k, x", f"return {_sum([f'rows[k, {j}] * x[{j}]' for j in range(x.count)])}"
    )


@overload(loaded, strict=False)
def _loaded(values: Any, x: Any) -> Callable[..., Any]:
    parts = ", ".join(f"values[{j}]" for j in range(x.count))
    return _function("values, x", f"return ({parts},)")


@overload(stored, strict=False)
def _stored(values: Any, x: Any) -> Callable[..., Any]:
    return _function("values, x", "\n    ".join(f"values[{j}] = x[{j}]" for j in range(x.count)))


@numba.njit(cache=True, nogil=True, fastmath={"contract", "nsz"})
def propagate_plain(
    start: State,
    state: FloatArray,
    matrix: FloatArray,
    beta: FloatArray,
    alpha: FloatArray,
    alpha_half: FloatArray,
    rate_row: FloatArray,
    rate_b: FloatArray,
    velocity: FloatArray,
    direct: FloatArray,
    c: FloatArray,
    drive: FloatArray,
    stride: int,
    out: FloatArray,
) -> None:
    """Advance `state` (n,) in place; `start` is any tuple of n floats, which gives the order.

    `velocity` (1, n); everything else as in `kernel.propagate`.
    """
    x = loaded(state, start)
    n = len(start)
    poly = (c[0], c[1], c[2], c[3], c[4], c[5])
    a_f, a_u = alpha[0, 0], alpha[0, 2]
    h_f, h_u = alpha_half[0, 0] - a_f, alpha_half[0, 2] - a_u
    b_f, b_u = rate_b[0, 0], rate_b[0, 2]
    step = 0
    for frame in range(out.shape[0]):
        for sub in range(stride):
            u0, uh, u1 = drive[2 * step], drive[2 * step + 1], drive[2 * step + 2]
            y = stepped(matrix, x)
            z, zh, zf = y[n], y[n + 1], y[n + 2]
            f0 = polynomial(poly, z)
            if sub == 0:
                out[frame, 0] = row_times(velocity, 0, x) + direct[1] * f0
                out[frame, 1] = z
                rate = polynomial_slope(poly, z) * (y[n + 3] + b_f * f0 + b_u * u0)
                for m in range(out.shape[1] - 2):
                    p = row_times(rate_row, 1 + m, x) + direct[2 + m] * rate
                    out[frame, 2 + m] = p + (rate_b[1 + m, 0] * f0 + rate_b[1 + m, 2] * u0)
            fa = polynomial(poly, zh + (a_f * f0 + a_u * u0))
            fb = polynomial(poly, (zh + a_u * uh) + a_f * fa)
            fc = polynomial(poly, ((zf + h_u * u0 + 2 * a_u * uh) + h_f * f0) + 2 * a_f * fb)
            x = pushed(beta, y, x, (f0, fa + fb, fc), (u0, 2 * uh, u1))
            step += 1
    stored(state, x)
