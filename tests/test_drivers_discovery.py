"""Discovery never fails, and says what is missing."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from drivers import discovery
from drivers.discovery import DeviceInfo, discover

ROOT = Path(__file__).resolve().parents[1]


def absent() -> list[DeviceInfo]:
    raise OSError("library gone: apt install it")


def stuck() -> list[DeviceInfo]:
    threading.Event().wait()
    return []


def present() -> list[DeviceInfo]:
    return [DeviceInfo("kept", "one")]


def test_every_absent_family_is_named_and_hides_no_other(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that hangs, as PortAudio does on a wedged sound server, is given up in its time."""
    monkeypatch.setattr(discovery, "FAMILIES", {"broken": absent, "kept": present})
    assert discover() == [
        DeviceInfo("broken", "broken", missing="library gone: apt install it"),
        DeviceInfo("kept", "one"),
    ]
    monkeypatch.setattr(discovery, "SEARCH_S", 0.3)
    monkeypatch.setattr(discovery, "FAMILIES", {"stuck": stuck})
    (found,) = discover()
    assert found.missing == "stuck: no answer within 0.3 s; given up"


def test_this_machine_is_listed_without_portaudio(tmp_path: Path) -> None:
    """The real search, in processes whose loader finds no PortAudio."""
    (tmp_path / "sitecustomize.py").write_text(
        "import ctypes.util; ctypes.util.find_library = lambda name: None\n"
    )
    script = (
        "from drivers.discovery import discover\n"
        "for device in discover(): print(device.family, '|', device.missing)\n"
    )
    said = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": str(tmp_path)},
    )
    assert "sound card | PortAudio library not found: apt install libportaudio2" in said.stdout
    assert "Traceback" not in said.stderr
