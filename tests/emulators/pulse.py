"""A private PulseAudio server with a null sink, and the ALSA devices through which to reach it.

What is played to ``rig_loop`` comes back from ``rig_loop_in`` (the sink's monitor), sample for
sample. ``norewinds=1`` because the monitor otherwise repeats and skips frames; plain channel
names because ``aux`` maps record silence.

A witness (``parec``) records the monitor all the time: an independent ear for what still sounds
after the process under test is gone, and what keeps the monitor from serving stale frames to the
next one that opens it.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

CHANNELS = 4
MAP = "front-left,front-right,rear-left,rear-right"
RATE_HZ = 48000

SERVER = """\
.fail
load-module module-native-protocol-unix auth-anonymous=1 socket={socket}
load-module module-null-sink sink_name=rig rate={rate} channels={channels} \
format=float32le norewinds=1 channel_map={map}
"""
DEVICES = """\
</usr/share/alsa/alsa.conf>
pcm.rig_loop {{ type pulse
  server "unix:{socket}"
  device "rig"
  hint {{ show on description "rig loop" }} }}
pcm.rig_loop_in {{ type pulse
  server "unix:{socket}"
  device "rig.monitor"
  hint {{ show on description "rig loop in" }} }}
"""


class PulseLoop:
    """Start with `with`; sets ALSA_CONFIG_PATH of this process while it runs."""

    def __init__(self, rate_hz: int = RATE_HZ) -> None:
        self.rate_hz = rate_hz
        self._folder = tempfile.TemporaryDirectory(prefix="entrain-pulse-")
        self._process: subprocess.Popen[bytes] | None = None
        self._witness: subprocess.Popen[bytes] | None = None
        self._saved = os.environ.get("ALSA_CONFIG_PATH")

    @property
    def folder(self) -> Path:
        return Path(self._folder.name)

    @property
    def socket(self) -> Path:
        return self.folder / "native"

    @property
    def asound(self) -> Path:
        return self.folder / "asound.conf"

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def kill(self) -> None:
        """As if the card were pulled out."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def __enter__(self) -> Self:
        script = self.folder / "default.pa"
        script.write_text(
            SERVER.format(socket=self.socket, rate=self.rate_hz, channels=CHANNELS, map=MAP)
        )
        self.asound.write_text(DEVICES.format(socket=self.socket))
        home = {
            "PULSE_RUNTIME_PATH": str(self.folder),
            "XDG_CONFIG_HOME": str(self.folder),
            "HOME": str(self.folder),
        }
        options = ["--daemonize=no", "--exit-idle-time=-1", "--use-pid-file=no", "--disallow-exit"]
        options += ["--disable-shm=yes", "--realtime=no", "--high-priority=no"]
        with (self.folder / "pulse.log").open("wb") as log:
            self._process = subprocess.Popen(
                ["pulseaudio", "-n", "-F", str(script), *options],
                env=os.environ | home,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        deadline = time.monotonic() + 10.0
        while not self._answers():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self._process.kill()
                said = (self.folder / "pulse.log").read_text()
                raise RuntimeError(f"pulseaudio did not start:\n{said}")
            time.sleep(0.05)
        options = [
            "--raw",
            "--format=float32le",
            f"--rate={self.rate_hz}",
            f"--channels={CHANNELS}",
        ]
        options += [f"--channel-map={MAP}", "--latency-msec=10", "-d", "rig.monitor"]
        with (self.folder / "witness").open("wb") as heard:
            self._witness = subprocess.Popen(
                ["parec", "-s", f"unix:{self.socket}", *options],
                stdout=heard,
                stderr=subprocess.DEVNULL,
            )
        while self.heard().shape[0] == 0:
            if self._witness.poll() is not None or time.monotonic() > deadline:
                raise RuntimeError("parec does not record the monitor")
            time.sleep(0.02)
        os.environ["ALSA_CONFIG_PATH"] = str(self.asound)
        return self

    def heard(self) -> npt.NDArray[np.float32]:
        """Everything that left the sink so far, (frames, channels)."""
        found = np.fromfile(self.folder / "witness", np.float32)
        return found[: found.size // CHANNELS * CHANNELS].reshape(-1, CHANNELS)

    def sounded_s(self, since_frame: int) -> float:
        """Seconds from `since_frame` to channel 0's last frame with sound; it sounded before."""
        drive = np.abs(self.heard()[:, 0])
        just_before = drive[since_frame - self.rate_hz // 20 : since_frame]
        assert np.max(just_before) > 0.4, "it did not sound"
        heard = np.flatnonzero(drive[since_frame:])
        return float(heard[-1] + 1) / self.rate_hz if heard.size else 0.0

    def _answers(self) -> bool:
        answer = subprocess.run(
            ["pactl", "-s", f"unix:{self.socket}", "info"], capture_output=True, check=False
        )
        return answer.returncode == 0

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for process in (self._witness, self._process):
            assert process is not None
            if process.poll() is None:
                process.terminate()
            try:
                process.wait(3.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._saved is None:
            os.environ.pop("ALSA_CONFIG_PATH", None)
        else:
            os.environ["ALSA_CONFIG_PATH"] = self._saved
        self._folder.cleanup()
