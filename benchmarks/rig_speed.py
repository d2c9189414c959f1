"""Speed and accuracy of the rig's integrator, in one run: ``python benchmarks/rig_speed.py``.

Prints, as a table and (``--json FILE``) as JSON:

* the error on the limit cycle against step size (reference: harmonic balance, 15 harmonics);
* time for one second of the limit cycle at equal accuracy (1e-6) beside ``solve_ivp``, the best
  of RK45, DOP853 and LSODA, each at the loosest tolerance that reaches it;
* time per step beside the same scheme written by hand in C (``gcc -O3 -march=native``), once with
  the order known to the compiler and once not;
* many rigs at once on all cores; real-time factors for 2, 4 and 8 modes at the rig's 50 kHz;
* a whole recorded campaign of eleven runs, through microphones, filters and converter.

Times are the best of several, in CPU seconds of the thread where one thread runs, so that other
work on the machine does not count.
"""

import argparse
import ctypes
import json
import os
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from simulated_rig import build_config
from simulated_rig.campaigns import PlannedRun, simulate_campaign
from simulated_rig.fleet import run_fleet
from simulated_rig.orbits import free_orbit
from simulated_rig.plant import Plant
from simulated_rig.presets import thesis_four_mode, thesis_two_mode
from simulated_rig.simulation import Simulation, propagator
from simulated_rig.statespace import assemble
from simulated_rig.tube import Tube, tube_plant

MICROPHONES = (0.6604, 0.7112)
C_SOURCE = r"""
#ifdef ORDER
#define N ORDER
#else
#define N n
#endif
/* ETDRK4 with a cubic and a drive; matrix rows: E (n), z, z half, z full, per column, padded. */
void run(int n, long steps, double *restrict x, const double *restrict m, int ld,
         const double *restrict beta, int lb, const double *restrict al,
         const double *restrict ah, const double *restrict c, const double *restrict u,
         double *restrict out)
{
    double acc[64];
    for (long s = 0; s < steps; s++) {
        for (int i = 0; i < N + 3; i++) acc[i] = m[i] * x[0];
        for (int j = 1; j < N; j++)
            for (int i = 0; i < N + 3; i++) acc[i] += m[j * ld + i] * x[j];
        double z = acc[N], zh = acc[N + 1], zf = acc[N + 2];
        double u0 = u[2 * s], uh = u[2 * s + 1], u1 = u[2 * s + 2];
        double f0 = z * (c[1] + z * (c[2] + z * c[3]));
        double a = zh + al[0] * f0 + al[2] * u0;
        double fa = a * (c[1] + a * (c[2] + a * c[3]));
        double b = zh + al[0] * fa + al[2] * uh;
        double fb = b * (c[1] + b * (c[2] + b * c[3]));
        double e = zf + ah[0] * f0 + al[0] * (2 * fb - f0) + ah[2] * u0 + al[2] * (2 * uh - u0);
        double fc = e * (c[1] + e * (c[2] + e * c[3]));
        double fm = fa + fb, um = 2 * uh;
        out[s] = z;
        for (int i = 0; i < N; i++)
            x[i] = acc[i] + beta[i] * f0 + beta[lb + i] * fm + beta[2 * lb + i] * fc
                 + beta[6 * lb + i] * u0 + beta[7 * lb + i] * um + beta[8 * lb + i] * u1;
    }
}
"""


def best(act: Callable[[], object], repeats: int = 7) -> float:
    """Least CPU seconds of this thread."""
    times = []
    for _ in range(repeats):
        start = time.thread_time()
        act()
        times.append(time.thread_time() - start)
    return min(times)


def cycle_error(
    frequency_hz: float, coefficients: np.ndarray, t: np.ndarray, y: np.ndarray
) -> float:
    """Largest deviation of y from the orbit, in amplitudes, at the phase that fits best: a wrong
    frequency shows over the second."""
    harmonics = np.arange(coefficients.size)
    base = 2 * np.pi * frequency_hz * t
    mean = 2 * np.mean(y * np.exp(-1j * base))
    shift = float(np.angle(mean) - np.angle(coefficients[1]))
    for _ in range(6):  # Gauss-Newton on the one unknown
        waves = np.exp(1j * np.outer(base + shift, harmonics))
        error = y - np.real(waves @ coefficients)
        slope = np.real(waves @ (1j * harmonics * coefficients))
        shift += float(slope @ error / (slope @ slope))
    return float(np.max(np.abs(error)) / abs(coefficients[1]))


def right_hand_side(plant: Plant) -> Callable[[float, np.ndarray], np.ndarray]:
    """The same system as plain NumPy, as a user of solve_ivp would write it."""
    system = assemble(plant, MICROPHONES)
    a, b, z = system.a, system.b[:, 0], system.z
    c1, c2, c3 = plant.characteristic.coefficients[1:4]

    def f(t: float, x: np.ndarray) -> np.ndarray:
        s = z @ x
        return np.asarray(a @ x + b * (s * (c1 + s * (c2 + s * c3))))

    return f


def on_cycle(plant: Plant) -> np.ndarray:
    """A state on the limit cycle."""
    rig = Simulation(propagator(plant, MICROPHONES, 1e-5))
    rig.run(np.zeros(2 * 1_000_000 + 1), 1_000_000)
    return rig.x.copy()


def accuracy(plant: Plant, state: np.ndarray) -> list[dict[str, float]]:
    """Error and time of one second of limit cycle by step size."""
    orbit = free_orbit(plant, 15)
    assert orbit is not None
    found = []
    for rate in (2500.0, 5000.0, 7500.0, 10000.0, 15000.0, 20000.0, 50000.0):
        steps = round(rate)
        drive = np.zeros(2 * steps + 1)
        prepared = propagator(plant, MICROPHONES, 1 / rate)

        def run(prepared: object = prepared, drive: np.ndarray = drive) -> np.ndarray:
            rig = Simulation(prepared)  # type: ignore[arg-type]
            rig.x[:] = state
            return rig.run(drive)[:, 0]

        y = run()
        t = np.arange(steps) / rate
        error = cycle_error(orbit.frequency_hz, orbit.velocity, t, y)
        found.append({"rate_hz": rate, "error": error, "seconds": best(run)})
    return found


def by_solve_ivp(plant: Plant, state: np.ndarray, wanted: float) -> dict[str, float | str]:
    """Quickest method and tolerance with an error below `wanted`; output at 10 kHz."""
    orbit = free_orbit(plant, 15)
    assert orbit is not None
    f = right_hand_side(plant)
    t = np.arange(10000) / 10000.0
    y_row = assemble(plant, MICROPHONES)
    found: dict[str, float | str] = {"seconds": np.inf}
    for method in ("RK45", "DOP853", "LSODA"):
        for exponent in range(5, 12):
            tolerance = 10.0**-exponent
            start = time.thread_time()
            scale = np.abs(state).max() * np.array([1e-3] * 2 + [1.0] * 2 + [1e-2])
            solution = solve_ivp(
                f, (0, t[-1]), state, method, t_eval=t, rtol=tolerance, atol=tolerance * scale
            )
            seconds = time.thread_time() - start
            s = y_row.z @ solution.y
            direct = np.polynomial.Polynomial(plant.characteristic.coefficients)(s)
            y = y_row.velocity @ solution.y + y_row.velocity_direct * direct
            error = cycle_error(orbit.frequency_hz, orbit.velocity, t, y)
            if error < wanted:
                if seconds < float(found["seconds"]):
                    found = {
                        "method": method,
                        "rtol": tolerance,
                        "error": error,
                        "seconds": seconds,
                    }
                break
            if seconds > float(found["seconds"]):
                break
    return found


def by_c(plant: Plant, state: np.ndarray) -> dict[str, float]:
    """Nanoseconds a step of the C program and of ours, on the same numbers."""
    steps = 200_000
    c = propagator(plant, MICROPHONES, 1 / 20000.0).coefficients
    order = c.rate_row.shape[1]
    drive = 0.5 * np.sin(2 * np.pi * 168.0 * np.arange(2 * steps + 1) / 40000.0)
    poly = np.array(plant.characteristic.coefficients)
    pointer = ctypes.POINTER(ctypes.c_double)
    result: dict[str, float] = {}
    expected: np.ndarray | None = None
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "etd.c"
        source.write_text(C_SOURCE)
        for name, flags in (("c_generic", []), ("c_fixed_order", [f"-DORDER={order}"])):
            library = Path(folder) / f"{name}.so"
            command = ["gcc", "-O3", "-march=native", "-shared", "-fPIC", *flags]
            subprocess.run([*command, "-o", str(library), str(source)], check=True)
            run = ctypes.CDLL(str(library)).run
            out = np.empty(steps)
            x = np.empty(order)

            def call(run: object = run, x: np.ndarray = x, out: np.ndarray = out) -> None:
                x[:] = state
                arrays = (x, c.matrix, c.beta, c.alpha, c.alpha_half, poly, drive, out)
                px, pm, pb, pa, ph, pc, pu, po = (v.ctypes.data_as(pointer) for v in arrays)
                run(  # type: ignore[operator]
                    ctypes.c_int(order),
                    ctypes.c_long(steps),
                    px,
                    pm,
                    ctypes.c_int(c.matrix.shape[1]),
                    pb,
                    ctypes.c_int(c.beta.shape[1]),
                    pa,
                    ph,
                    pc,
                    pu,
                    po,
                )

            result[f"{name}_ns"] = best(call) / steps * 1e9
            expected = out.copy()
    rig = Simulation(propagator(plant, MICROPHONES, 1 / 20000.0))

    def ours(stride: int) -> np.ndarray:
        rig.x[:] = state
        return rig.run(drive, stride)

    z = ours(2)[:, 1]
    assert expected is not None
    result["difference"] = float(np.max(np.abs(z - expected[::2])) / np.max(np.abs(z)))
    result["ours_with_four_outputs_every_other_step_ns"] = best(lambda: ours(2)) / steps * 1e9
    # The C program writes z only: every hundredth step four outputs cost as little.
    result["ours_ns"] = best(lambda: ours(100)) / steps * 1e9
    for name in ("c_generic", "c_fixed_order"):
        result[f"speed_relative_to_{name}"] = result[f"{name}_ns"] / result["ours_ns"]
    return result


def fleet(plant: Plant, rigs: int = 64, steps: int = 20000) -> dict[str, float]:
    """Wall-clock nanoseconds a rig-step with one thread and with all cores."""
    prepared = propagator(plant, MICROPHONES, 1 / 20000.0)
    members = [Simulation(prepared) for _ in range(rigs)]
    drives = [np.zeros(2 * steps + 1) for _ in range(rigs)]
    result = {}
    for workers in sorted({1, os.cpu_count() or 1}):
        times = []
        for _ in range(3):
            start = time.perf_counter()
            run_fleet(members, drives, steps, workers)
            times.append(time.perf_counter() - start)
        result[f"workers_{workers}_ns"] = min(times) / rigs / steps * 1e9
    return result


def real_time_factors() -> dict[str, float]:
    """Seconds of plant per CPU second at 50 kHz, every step an output."""
    eight = tube_plant(Tube(), [0.01] + [0.05] * 7)
    eight = replace(eight, characteristic=thesis_two_mode().characteristic)
    plants = {"2": thesis_two_mode(), "4": thesis_four_mode(), "8": eight}
    drive = np.zeros(2 * 50000 + 1)
    result = {}
    for name, plant in plants.items():
        rig = Simulation(propagator(plant, MICROPHONES, 2e-5))
        result[name] = 1.0 / best(lambda rig=rig: rig.run(drive))  # type: ignore[misc]
    return result


def campaign_seconds() -> float:
    """One campaign of a free and ten forced runs, as `entrain` records it on the simulated rig."""
    config = build_config()
    plan = [PlannedRun("free")]
    plan += [PlannedRun("forced", float(f), 1.0, settle_s=3.0) for f in range(163, 173)]
    times = []
    for _ in range(3):
        start = time.process_time()  # its runs are shared out to threads
        simulate_campaign(config, plan)
        times.append(time.process_time() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    plant = thesis_two_mode()
    state = on_cycle(plant)
    table = accuracy(plant, state)
    print("step rate Hz   error on the cycle   ms per second of cycle")
    for row in table:
        print(f"{row['rate_hz']:12g} {row['error']:20.2e} {1e3 * row['seconds']:24.3f}")
    enough = min((r for r in table if r["error"] < 1e-6), key=lambda r: r["seconds"])
    other = by_solve_ivp(plant, state, 1e-6)
    ratio = float(other["seconds"]) / enough["seconds"]
    print(f"at 1e-6: {1e3 * enough['seconds']:.3f} ms at {enough['rate_hz']:g} Hz; {other}")
    print(f"times solve_ivp: {ratio:.0f}")
    c = by_c(plant, state)
    print("against C:", {k: float(f"{v:.3g}") for k, v in c.items()})
    many = fleet(plant)
    print("64 rigs, wall ns per rig-step:", {k: round(v, 1) for k, v in many.items()})
    factors = real_time_factors()
    print("real-time factor at 50 kHz by modes:", {k: round(v) for k, v in factors.items()})
    campaign = campaign_seconds()
    print(f"a campaign of eleven runs: {campaign:.3f} CPU s")
    if arguments.json:
        report = {
            "accuracy": table,
            "solve_ivp": other,
            "times_solve_ivp": ratio,
            "c": c,
            "fleet": many,
            "real_time_factor": factors,
            "campaign_s": campaign,
        }
        arguments.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
