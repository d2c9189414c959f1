"""A controller as a process on the audio side: ``python benchmarks/outside_controller.py``.

A JACK client of its own, patched to a running ``entrain hil --input system --output system --api
"JACK Audio Connection Kit"``: it hears p1 and drives the speaker's line, first with zeros, then
with the phase shifter of Fig. 1.4, and prints the tube's pressure before and after as JSON. Put any
other law in `Loop.answer`. The way round is two JACK periods and the plant's anti-aliasing filter;
the phase shifter leads by as much.

It may be started before the plant. ``--freewheel`` lets JACK run as fast as its clients answer:
the same samples in every run, on a busy machine too. Needs ``pip install JACK-Client`` and a JACK
server (`JACK_DEFAULT_SERVER`).
"""

import argparse
import json
import sys
import threading
import time
from typing import Any

import jack
import numpy as np
from scipy.signal import lfilter, ss2tf

from simulated_rig.controllers import PhaseShifter
from simulated_rig.sensors import LATENCY_FRAMES

PA_PER_SAMPLE = 10.0 / 0.002  # full scale of the line over the microphone's sensitivity
CENTER_HZ, LIMIT_V = 170.0, 1.0
WINDOW_S = 0.5  # over which the pressure is averaged


class Loop:
    """What is heard and said: `before_s` of silence, then the law, `after_s` of it."""

    def __init__(self, client: Any, phase_deg: float, gain: float, before_s: float, after_s: float):
        rate = float(client.samplerate)
        lag = (2 * client.blocksize + LATENCY_FRAMES) / rate
        phase = np.radians(phase_deg) + 2 * np.pi * CENTER_HZ * lag
        shifter = PhaseShifter(CENTER_HZ, phase_rad=phase, gain_v_per_pa=gain, limit_v=LIMIT_V)
        law = shifter.linear(rate, 1)
        c = law.c[None]
        numerator, self._a = ss2tf(law.a, law.b, c @ law.a, c @ law.b)
        self._b, self._state = numerator[0], np.zeros(law.order)
        self._quiet, self._whole = round(before_s * rate), round((before_s + after_s) * rate)
        self._window = round(WINDOW_S * rate)
        self._heard: list[Any] = []
        self._frames = 0
        self.alive, self.running, self.done = (threading.Event() for _ in range(3))

    def answer(self, pressure_pa: Any) -> Any:
        """Volts for a block of pressures."""
        volts, self._state = lfilter(self._b, self._a, pressure_pa, zi=self._state)
        return np.clip(volts, -LIMIT_V, LIMIT_V)

    def block(self, heard: Any, said: Any) -> None:
        """One JACK period."""
        pressure = heard.astype(float) * PA_PER_SAMPLE
        volts = self.answer(pressure)
        said[:] = 0.0
        if pressure.any():
            self.alive.set()
        if not self.running.is_set() or self.done.is_set():
            return
        if self._frames >= self._quiet:
            said[:] = volts
        self._frames += heard.size
        self._heard.append(pressure)
        if self._frames >= self._whole:
            self.done.set()

    def result(self) -> dict[str, float]:
        """Rms pressure before and after, and the suppression."""
        p = np.concatenate(self._heard)
        free = float(np.std(p[self._quiet - self._window : self._quiet]))
        held = float(np.std(p[-self._window :]))
        return {"free_pa": free, "held_pa": held, "suppression_db": 20 * np.log10(free / held)}


def patch(client: Any, heard: Any, said: Any, timeout_s: float) -> None:
    """Connect to the plant's lines instead of the server's own."""
    end = time.monotonic() + timeout_s
    while True:
        plant = client.get_ports("PortAudio.*")
        # PortAudio connects its ports one after the other; all must be there to be undone.
        if plant and all(client.get_all_connections(port) for port in plant):
            break
        if time.monotonic() > end:
            raise SystemExit("no plant on this JACK server: start entrain hil first")
        time.sleep(0.02)
    for port in plant:
        for other in client.get_all_connections(port):
            client.disconnect(*((port, other) if port.is_output else (other, port)))
    client.connect(next(port for port in plant if port.is_output), heard)
    client.connect(said, next(port for port in plant if port.is_input))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--phase-deg", type=float, default=285.0)
    parser.add_argument("--gain", type=float, default=1e-3, help="V/Pa")
    parser.add_argument("--before-s", type=float, default=3.0)
    parser.add_argument("--after-s", type=float, default=4.0)
    parser.add_argument("--freewheel", action="store_true")
    options = parser.parse_args()
    client = jack.Client("controller", no_start_server=True)
    loop = Loop(client, options.phase_deg, options.gain, options.before_s, options.after_s)
    heard, said = client.inports.register("p1"), client.outports.register("speaker")
    client.set_process_callback(lambda _: loop.block(heard.get_array(), said.get_array()))
    left = threading.Event()
    client.set_freewheel_callback(lambda on: None if on else left.set())
    with client:
        print("waiting for the plant", file=sys.stderr, flush=True)
        patch(client, heard, said, 30.0)
        if not loop.alive.wait(30.0):
            raise SystemExit("the plant is silent")
        if options.freewheel:
            client.set_freewheel(True)
        loop.running.set()
        finished = loop.done.wait(60.0)
        if options.freewheel:  # before the plant ends: JACK wedges otherwise
            client.set_freewheel(False)
            left.wait(5.0)
    if not finished:
        raise SystemExit("the JACK server stands still")
    print(json.dumps(loop.result()))


if __name__ == "__main__":
    main()
