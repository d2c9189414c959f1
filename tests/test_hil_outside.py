"""A user's controller as a process on the audio side, in a loop with the plant's process over JACK.

The server runs free of the clock (freewheel), so the samples are the same however busy the machine.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from simulated_rig import build_config
from simulated_rig.hil.loop import PlantLoop
from tests.emulators.jack import HOST_API, jack_server

ROOT = Path(__file__).resolve().parents[1]

pytestmark = [pytest.mark.component("PortAudio"), pytest.mark.component("JACK")]


@contextmanager
def running(
    command: list[str], env: dict[str, str], **pipes: int
) -> Iterator[subprocess.Popen[str]]:
    """A process that is killed at the end: after freewheel a JACK client may not end by itself."""
    with subprocess.Popen(command, env=env, cwd=ROOT, text=True, **pipes) as process:
        try:
            yield process
        finally:
            process.kill()


def suppressed(phase_deg: float) -> dict[str, float]:
    """What the controller's process heard of a plant, on a server of their own.

    The controller is up first: until the server runs free of the clock, a busy machine may lose
    frames, which is a fault of the plant.
    """
    outside = [sys.executable, "benchmarks/outside_controller.py", "--freewheel"]
    outside += ["--phase-deg", str(phase_deg), "--before-s", "2", "--after-s", "2"]
    plant = [sys.executable, "-m", "daq.cli", "hil", "--input", "system", "--output", "system"]
    plant += ["--api", HOST_API]
    pipe = subprocess.PIPE
    with jack_server() as server:
        env = server | {"PYTHONPATH": str(ROOT)}
        with running(outside, env, stdout=pipe, stderr=pipe) as controller:
            assert controller.stderr is not None
            while "waiting" not in (line := controller.stderr.readline()):
                assert line, "the controller ended"
            with running(plant, env, stdout=subprocess.DEVNULL):
                said, errors = controller.communicate(timeout=60.0)
            assert controller.returncode == 0, errors
    found: dict[str, float] = json.loads(said)
    return found


def test_a_process_on_the_audio_side_silences_the_tube() -> None:
    """The free tube is as loud as the plant alone. The loop is open for two periods and a filter,
    10.9 ms, in which the mode grows by e^(6.0 · 0.0109) = 7 %: the phase shifter has margin for
    that, and what stays is the microphones' 0.2 Pa; turned by 180° it does not stabilise."""
    found = suppressed(285.0)
    config = build_config("thesis-two-mode")
    alone = PlantLoop(config, 48000.0).process(np.zeros(96000))[-24000:, 0]
    assert found["free_pa"] == pytest.approx(float(np.std(alone)), rel=0.01)
    assert found["held_pa"] < 0.3
    assert suppressed(105.0)["suppression_db"] < 3.0
