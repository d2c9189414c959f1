"""A private sound server without a sound card, to put plant and acquisition on one machine.

PulseAudio with two null sinks, crossed: what the acquisition plays, the plant hears, and the other
way round. ALSA devices of these names lead there, for PortAudio's host API ``ALSA``:

    acquisition: rig_daq (out), rig_daq_in        plant: rig_plant (out), rig_plant_in

The server and its files are this object's own; PortAudio looks for devices when it is first used in
a process, so start the server before, or `drivers.audio_devices.rescan()`.
"""

import os
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from drivers.errors import DeviceNotFound, MissingDependency
from simulated_rig.hil.audio import AudioSettings

CHANNELS = 4
#: ALSA name: PulseAudio's device. A sink's monitor is what was played to it.
DEVICES = {
    "rig_daq": "to_plant",
    "rig_plant_in": "to_plant.monitor",
    "rig_plant": "to_daq",
    "rig_daq_in": "to_daq.monitor",
}
# norewinds: a monitor otherwise repeats and skips; plain channel names: aux maps record silence.
SINK = (
    "load-module module-null-sink sink_name={name} rate={rate} channels={channels} "
    "format=float32le norewinds=1 "
    "channel_map=front-left,front-right,rear-left,rear-right\n"
)
START_S = 15.0


class SoundServer:
    """Up from `__enter__` to `__exit__`; sets ALSA_CONFIG_PATH of this process meanwhile.

    Raises `MissingDependency` without PulseAudio, `DeviceNotFound` when it does not come up.
    """

    def __init__(self, rate_hz: int = 48000) -> None:
        self.rate_hz = rate_hz
        self._folder = tempfile.TemporaryDirectory(prefix="entrain-hil-")
        self._process: subprocess.Popen[bytes] | None = None
        self._saved = os.environ.get("ALSA_CONFIG_PATH")

    @property
    def asound(self) -> Path:
        """The ALSA configuration that other processes need as ALSA_CONFIG_PATH."""
        return Path(self._folder.name) / "asound.conf"

    @property
    def plant(self) -> AudioSettings:
        """The plant's side."""
        last = CHANNELS - 1
        return AudioSettings(
            "rig_plant_in", "rig_plant", "ALSA", float(self.rate_hz), counter=(last, last)
        )

    def kill(self) -> None:
        """As if the card were pulled out."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def __enter__(self) -> Self:
        folder = Path(self._folder.name)
        socket = folder / "native"
        script = (
            f".fail\nload-module module-native-protocol-unix auth-anonymous=1 socket={socket}\n"
        )
        for name in ("to_plant", "to_daq"):
            script += SINK.format(name=name, rate=self.rate_hz, channels=CHANNELS)
        (folder / "default.pa").write_text(script)
        devices = "</usr/share/alsa/alsa.conf>\n"
        for name, target in DEVICES.items():
            devices += (
                f'pcm.{name} {{ type pulse\n  server "unix:{socket}"\n  device "{target}"\n'
                f'  hint {{ show on description "{name}" }} }}\n'
            )
        self.asound.write_text(devices)
        home = dict.fromkeys(("PULSE_RUNTIME_PATH", "XDG_CONFIG_HOME", "HOME"), str(folder))
        command = ["pulseaudio", "-n", "-F", str(folder / "default.pa"), "--daemonize=no"]
        command += ["--exit-idle-time=-1", "--use-pid-file=no", "--disallow-exit"]
        command += ["--disable-shm=yes", "--realtime=no", "--high-priority=no"]
        try:
            with (folder / "log").open("wb") as log:
                self._process = subprocess.Popen(
                    command,
                    env=os.environ | home,
                    stdout=subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,  # the terminal's Ctrl-C is for whoever started it
                )
        except FileNotFoundError as error:
            raise MissingDependency(
                "pulseaudio missing: apt install pulseaudio pulseaudio-utils libasound2-plugins"
            ) from error
        deadline = time.monotonic() + START_S
        while not self._answers(socket):
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                said = (folder / "log").read_text()
                raise DeviceNotFound(f"pulseaudio did not start within {START_S} s: {said}")
            time.sleep(0.05)
        os.environ["ALSA_CONFIG_PATH"] = str(self.asound)
        return self

    @staticmethod
    def _answers(socket: Path) -> bool:
        command = ["pactl", "-s", f"unix:{socket}", "info"]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._process is not None and self._process.poll() is None:
            self._process.terminate()
            try:
                self._process.wait(3.0)
            except subprocess.TimeoutExpired:
                self.kill()
        if self._saved is None:
            os.environ.pop("ALSA_CONFIG_PATH", None)
        else:
            os.environ["ALSA_CONFIG_PATH"] = self._saved
        self._folder.cleanup()
