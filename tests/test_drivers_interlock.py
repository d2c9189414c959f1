"""The interlock is fail-safe, and a machine without a component is told so, not passed over."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from drivers.errors import InterlockOpen
from drivers.interlock import InterlockWatch
from drivers.serial_devices import ask_value
from drivers.serialport import SerialPort
from drivers.types import OutputLimits, Tone
from tests.emulators.looprig import LoopRig
from tests.emulators.terminal import LineTone

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize("fault", ["open", "unplugged"])
def test_an_open_or_unreadable_interlock_stops_the_rig_until_reset(fault: str) -> None:
    with LineTone() as device, LoopRig(OutputLimits(1.0, max_slew_v_per_s=50.0)) as rig:
        device.values["DOOR"] = 1.0
        port = SerialPort(device.name, timeout_s=0.2)
        with InterlockWatch(rig, "door", lambda: ask_value(port, "DOOR") == 1.0) as watch:
            rig.start()
            rig.drive(Tone(170.0, 1.0))
            rig.read(400)
            assert rig.status().output_v == 1.0
            if fault == "open":
                device.values["DOOR"] = 0.0
            else:
                device.unplug()
            deadline = time.monotonic() + 1.0
            while watch.reason is None and time.monotonic() < deadline:
                time.sleep(0.005)
            rig.read(400)
            assert rig.status().output_v == 0.0
            assert "door" in str(rig.status().muted)
            with pytest.raises(InterlockOpen, match="door"):
                rig.drive(Tone(170.0, 1.0))
            with pytest.raises(InterlockOpen, match="close it, then reset"):
                watch.reset()
            if fault == "open":
                device.values["DOOR"] = 1.0
                watch.reset()
                rig.drive(Tone(170.0, 1.0))
        port.close()


@pytest.mark.parametrize(
    ("require", "outcome"), [("0", "1 skipped"), ("1", "1 error")], ids=["skips", "fails"]
)
def test_a_missing_component_is_named(tmp_path: Path, require: str, outcome: str) -> None:
    """A whole pytest of its own, whose loader finds no PortAudio."""
    (tmp_path / "conftest.py").write_text(
        "import ctypes.util\nctypes.util.find_library = lambda name: None\n"
    )
    (tmp_path / "test_one.py").write_text(
        "import pytest\n\n@pytest.mark.component('PortAudio')\ndef test_one(): pass\n"
    )
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = component(name): x\n")
    options = ["-ra", "-p", "tests.conftest", "-p", "no:cacheprovider"]
    said = subprocess.run(
        [sys.executable, "-m", "pytest", *options, str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        env=os.environ
        | {"ENTRAIN_REQUIRE_COMPONENTS": require, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"},
    )
    assert outcome in said.stdout, said.stdout + said.stderr
    assert "PortAudio not found: apt install libportaudio2" in said.stdout
