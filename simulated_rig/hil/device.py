"""The plant as a device: volts at the loudspeaker's amplifier in, microphone volts out.

    audio line in ─┐
    generator ─────┴─ amplifier ─ speaker, tube, flame ─ microphones ─ converter ─ lines out
                                       └─ controller ─┘

The same plant and the same measuring chain as `SimulatedRig`; what differs is who asks for time to
pass. Lines out are p1, p2 and the drive (what the amplifier puts on the loudspeaker), in volts.
"""

import time
from dataclasses import replace

import numpy as np

from drivers.types import Channel, FloatArray
from simulated_rig.config import RigConfig
from simulated_rig.controllers import Law, LinearController
from simulated_rig.hil.amplifier import Amplifier
from simulated_rig.hil.generator import Generator
from simulated_rig.hil.loop import PlantLoop
from simulated_rig.hil.watch import Watch
from simulated_rig.rig import WARM_UP_S
from simulated_rig.sensors import Chain


def lines(config: RigConfig) -> tuple[Channel, ...]:
    """What the device's lines out carry, as an acquisition has to describe them."""
    full = config.converter.full_scale_v
    pressure = [
        Channel(f"p{i}", "pressure", "Pa", m.volts_per_pa, full, position_m=m.position_m)
        for i, m in enumerate(config.microphones, start=1)
    ]
    return (*pressure, Channel("drive", "voltage", "V", 1.0, full))


class Device:
    """`process` is called by one thread, the one that paces the plant.

    A fault silences: from then on every line out is zero, and the plant stands still.
    """

    def __init__(
        self,
        config: RigConfig,
        rate_hz: float,
        watch: Watch,
        controller: LinearController | Law | None = None,
        generator: Generator | None = None,
        amplifier: Amplifier | None = None,
        seed: int = 0,
    ) -> None:
        self.rate_hz = rate_hz
        self.watch = watch
        self.loop = PlantLoop(config, rate_hz, seed=seed)
        self.generator = generator
        self.amplifier = amplifier
        self._channels = len(lines(config))
        # Without oversampling: the plant hands over one pressure a frame.
        self._chain = Chain(replace(config, sample_rate_hz=rate_hz), 1, [seed, 4])
        # Also compiles what is compiled, before anybody waits.
        self.loop.process(np.zeros(round(WARM_UP_S * rate_hz)))
        self._chain.process(np.zeros((64, 2)), np.zeros(64))
        if controller is not None and not isinstance(controller, LinearController):
            controller = self._interruptible(controller)
        self.loop.control(controller)

    def process(self, line_in_v: FloatArray) -> FloatArray:
        """Lines out (frames, 3) in volts for the line in (frames,) in volts."""
        frames = line_in_v.size
        if self.watch.fault is not None:
            return np.zeros((frames, self._channels))
        start = time.perf_counter()
        try:
            out = self._advance(line_in_v)
        except Exception as error:
            self.watch.fail(f"plant failed: {error}")
            return np.zeros((frames, self._channels))
        self.watch.block(frames, time.perf_counter() - start)
        return out

    def _interruptible(self, law: Law) -> Law:
        """`law`, given up in the middle of a block when a fault has been found meanwhile.

        Whatever it raises is an error of the plant's: its thread must not end without a fault.
        """

        def guarded(pressure_pa: FloatArray) -> float:
            if self.watch.fault is not None:
                raise ValueError(self.watch.fault)
            try:
                return law(pressure_pa)
            except (Exception, SystemExit) as error:
                raise ValueError(f"the controller failed: {error!r}") from error

        return guarded

    def _advance(self, line_in_v: FloatArray) -> FloatArray:
        drive = line_in_v
        if self.generator is not None:
            drive = drive + self.generator.render(drive.size, self.rate_hz)
        if self.amplifier is not None:
            drive = self.amplifier.process(drive, self.rate_hz)
        pressures = self.loop.process(drive)
        if not np.all(np.isfinite(pressures)):
            raise ValueError("the pressure is no longer finite: the controller drives it away")
        return self._chain.process(pressures, drive + self.loop.control_v)
