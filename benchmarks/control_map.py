"""The phase shifter of Fig. 1.4 over phase and gain: ``python benchmarks/control_map.py``.

Prints the map as a table and, with ``--figure FILE``, draws it: measured suppression of the limit
cycle (dB, colour), the boundary that the linear model's poles predict (line), and beside it a
fixed phase and the adaptive search while the gas cools by a given share of its frequency and the
flow rises. ``--json FILE`` keeps the numbers.
"""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from simulated_rig import OperatingPoint, Plant, RigConfig, build_config
from simulated_rig.controllers import PhaseSearch, PhaseShifter
from simulated_rig.hil.suppression import SuppressionMap, Tracked, suppression_map, track
from simulated_rig.operating import at_operating_point
from simulated_rig.plant import Turbulence

TURBULENCE_V = 0.02
COOLING = -0.15  # of every mode's frequency
MORE_FLOW = 0.1
SECONDS = 60.0


def rig() -> RigConfig:
    """The two-mode tube with the turbulence of the quiet one."""
    config = build_config("thesis-two-mode")
    return replace(config, plant=replace(config.plant, turbulence=Turbulence(TURBULENCE_V)))


def drifting(plant: Plant, share: float) -> Plant:
    """`plant` with that share of the drift."""
    factor = 1 + COOLING * share
    modes = tuple(replace(m, frequency_hz=m.frequency_hz * factor) for m in plant.modes)
    return at_operating_point(replace(plant, modes=modes), OperatingPoint(1 + MORE_FLOW * share))


def render(found: SuppressionMap, fixed: Tracked, adaptive: Tracked, path: Path) -> None:
    """Draw the map and the drift to `path` (format by its suffix)."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    degrees = np.rad2deg(found.phases_rad)
    most = float(np.max(np.abs(found.measured_db)))
    mesh = left.pcolormesh(
        degrees, found.gains_v_per_pa, found.measured_db, cmap="RdBu", vmin=-most, vmax=most
    )
    left.contour(degrees, found.gains_v_per_pa, found.growth_rate, levels=[0.0], colors="black")
    left.set(yscale="log", xlabel="phase (degrees)", ylabel="gain (V/Pa)")
    left.set_title("suppression (dB); line: poles of the linear loop on the axis")
    figure.colorbar(mesh, ax=left, label="dB")
    for run, name in ((fixed, "fixed phase"), (adaptive, "adaptive phase")):
        right.semilogy(run.time_s, run.pressure_pa, label=name)
    right.axhline(found.free_pa, color="grey", lw=0.8, label="free limit cycle")
    right.set(xlabel="time (s)", ylabel="rms pressure (Pa)")
    right.set_title(f"frequency {100 * COOLING:+.0f} %, flow {100 * MORE_FLOW:+.0f} %")
    right.legend()
    figure.savefig(path, dpi=120)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--phases", type=int, default=24)
    parser.add_argument("--gains", type=int, default=9)
    arguments = parser.parse_args()
    config, start = rig(), time.process_time()
    found = suppression_map(
        config,
        PhaseShifter(),
        np.arange(arguments.phases) * 2 * np.pi / arguments.phases,
        np.geomspace(5e-5, 5e-3, arguments.gains),
    )
    gain, phase = found.best
    stable = found.growth_rate < 0
    gap = found.measured_db[stable] - found.predicted_db[stable]
    settled = gap[found.growth_rate[stable] < -8]
    print(f"free limit cycle: {found.free_pa:.1f} Pa rms")
    print("gain V/Pa | suppression in dB over phase, * where the poles are stable")
    for row, value in enumerate(found.gains_v_per_pa):
        cells = [
            f"{found.measured_db[row, k]:+6.1f}{'*' if stable[row, k] else ' '}"
            for k in range(found.phases_rad.size)
        ]
        print(f"{value:9.2e} | {''.join(cells)}")
    best_deg = float(np.rad2deg(found.phases_rad[phase]))
    print(
        f"best: {found.measured_db[gain, phase]:.1f} dB at {best_deg:.0f}°, "
        f"{found.gains_v_per_pa[gain]:.2e} V/Pa "
        f"(predicted {found.predicted_db[gain, phase]:.1f} dB)"
    )
    print(f"measured − predicted where settled: {settled.mean():+.2f} ± {settled.std():.2f} dB")
    shifter = PhaseShifter(quality=8.0, gain_v_per_pa=2e-3, phase_rad=np.deg2rad(285.0))

    def plant_at(t: float) -> Plant:
        return drifting(config.plant, t / SECONDS)

    fixed = track(config, shifter, plant_at, SECONDS)
    adaptive = track(config, shifter, plant_at, SECONDS, PhaseSearch(shifter.phase_rad))
    for run, name in ((fixed, "fixed"), (adaptive, "adaptive")):
        last = float(np.sqrt(np.mean(run.pressure_pa[-10:] ** 2)))
        print(
            f"{name:8s}: {20 * np.log10(found.free_pa / last):.1f} dB after the drift, "
            f"phase {np.rad2deg(run.phase_rad[-1]):.0f}°, poles {run.growth_rate[-1]:+.1f} 1/s"
        )
    print(f"{time.process_time() - start:.0f} CPU seconds")
    if arguments.figure:
        render(found, fixed, adaptive, arguments.figure)
    if arguments.json:
        tables = {
            name: getattr(found, name).tolist()
            for name in (
                "phases_rad",
                "gains_v_per_pa",
                "measured_db",
                "growth_rate",
                "predicted_db",
            )
        }
        arguments.json.write_text(
            json.dumps(tables | {"free_pa": found.free_pa}).replace("NaN", "null")
        )


if __name__ == "__main__":
    main()
