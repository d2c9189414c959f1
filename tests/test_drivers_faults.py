"""The fault matrix: what goes wrong, and how soon the speaker is silent, heard on the audio loop.

An independent witness records what leaves the sound server. Silence is timed from the fault to
the last frame that is not exactly zero, so it contains everything: noticing, the ramp, the
buffers of PortAudio and of the server (66 ms of loop here).

+----------------------------+------------------------------+--------------------------------+
| fault                      | who notices                  | silent within                  |
+============================+==============================+================================+
| kill -9 of the service     | the rig's process (pipe end) | 200 ms, with a ramp            |
| kill -9, rig in-process    | the server drops the stream  | 200 ms, with a click           |
| SIGTERM of the service     | the rig's process (pipe end) | 200 ms, with a ramp            |
| service frozen (SIGSTOP)   | dead-man timer               | dead_man_s + 400 ms            |
| caller sleeps 2 s          | dead-man timer               | dead_man_s + 400 ms            |
| exception in the callback  | the callback itself          | 200 ms, reader gets DeviceLost |
| sound server gone          | finished callback or stall   | at once, reader DeviceLost     |
| reader too slow            | the ring is full             | goes on; a `Gap` of exact size |
| sound server stalls 0.4 s  | the xrun flag, the late      | blocks flagged, or DeviceLost  |
|                            | callback, the counter        |                                |
| sound server wedged        | who asked, in its time       | given up: DeviceLost, named by |
|                            |                              | `discover`; close() returns    |
| rig's process frozen       | who waits for it: no frames  | 200 ms (the card runs dry)     |
| full disk                  | the run's writer             | `tests/test_service_silence`   |
+----------------------------+------------------------------+--------------------------------+

On a busy machine PortAudio's ALSA side sometimes does not recover from the xrun (its poll fails
and the stream ends).
"""

import dataclasses
import functools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers import discovery, isolated
from drivers.audio_callback import AudioCallback
from drivers.audio_devices import rescan
from drivers.errors import DeviceLost, DeviceTimeout
from drivers.soundcard import SoundCardRig
from drivers.types import Tone
from tests.emulators.card import LIMITS, SETTINGS
from tests.emulators.pulse import RATE_HZ, PulseLoop

pytestmark = [pytest.mark.component("PortAudio"), pytest.mark.component("PulseAudio")]

ROOT = Path(__file__).resolve().parents[1]
WITHIN_S = 0.2


@pytest.fixture(scope="module")
def loop() -> Iterator[PulseLoop]:
    with PulseLoop() as loop:
        rescan()
        yield loop
    rescan()


@pytest.mark.parametrize(
    ("where", "fault", "within_s"),
    [
        ("isolated", signal.SIGKILL, WITHIN_S),
        ("inside", signal.SIGKILL, WITHIN_S),
        ("isolated", signal.SIGTERM, WITHIN_S),
        ("isolated", signal.SIGSTOP, LIMITS.dead_man_s + 2 * WITHIN_S),
    ],
)
def test_silent_after_the_service_is_struck(
    loop: PulseLoop, where: str, fault: signal.Signals, within_s: float
) -> None:
    service = subprocess.Popen(
        [sys.executable, "-m", "tests.emulators.service", where],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
    )
    assert service.stdout is not None
    with service, service.stdout:
        try:
            assert service.stdout.readline().startswith("sounding")
            time.sleep(0.2)  # until the tone has come through the loop
            since = loop.heard().shape[0]
            service.send_signal(fault)
            time.sleep(within_s + 0.3)
            silent_s = loop.sounded_s(since)
        finally:
            service.kill()
    print(f"{fault.name} of the service, rig {where}: silent after {silent_s * 1e3:.0f} ms")
    assert silent_s <= within_s


def sounding(rig: SoundCardRig) -> SoundCardRig:
    rig.start()
    rig.drive(Tone(500.0, 1.0))
    while rig.status().output_v < 1.0:
        rig.read(960)
    rig.read(4800)  # until the tone has come through the loop
    rig.feed()
    return rig


def test_silent_after_the_caller_sleeps(loop: PulseLoop) -> None:
    with SoundCardRig(SETTINGS, LIMITS) as rig:
        since = loop.heard().shape[0] if sounding(rig) else 0
        time.sleep(2.0)
        assert loop.sounded_s(since) <= LIMITS.dead_man_s + 2 * WITHIN_S
        assert "dead man" in str(rig.status().muted)
        # The recording went on meanwhile: nothing is lost, the ring holds ten seconds.
        before = rig.read(960)
        assert rig.read(round(1.9 * RATE_HZ)).first_frame == before.end_frame
        assert rig.status().gaps == ()


def test_an_exception_in_the_callback_silences_and_surfaces(loop: PulseLoop) -> None:
    with SoundCardRig(SETTINGS, LIMITS) as rig:
        sounding(rig)
        since = loop.heard().shape[0]
        rig.guard._scratch.ramp = None  # type: ignore[assignment]
        rig.guard._scratch.phase = None  # type: ignore[assignment]
        began = time.monotonic()
        with pytest.raises(DeviceLost, match="audio callback failed") as caught:
            rig.read(10 * RATE_HZ)
        assert time.monotonic() - began < 1.0
        assert isinstance(caught.value.__cause__, TypeError)
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)
        time.sleep(WITHIN_S + 0.1)
        assert loop.sounded_s(since) <= WITHIN_S


def test_a_slow_reader_loses_a_known_number_of_frames(loop: PulseLoop) -> None:
    settings = dataclasses.replace(SETTINGS, ring_s=0.25)
    with SoundCardRig(settings, LIMITS) as rig:
        rig.start()
        before = rig.read(480)
        time.sleep(0.6)
        blocks = [rig.read(2400) for _ in range(10)]
        jumps = [
            (b.first_frame - a.end_frame, "gap" in b.flags)
            for a, b in zip([before, *blocks], blocks, strict=False)
        ]
        lost = [jump for jump in jumps if jump[0]]
        assert len(lost) == 1
        assert lost[0][1]
        assert lost[0][0] == sum(gap.frames for gap in rig.status().gaps)
        # 0.6 s slept, 0.25 s held: 0.35 s, give or take the callbacks' period and the wake-up.
        assert lost[0][0] / RATE_HZ == pytest.approx(0.35, abs=0.15)


@pytest.mark.parametrize("told", [True, False], ids=["PortAudio says so", "PortAudio is silent"])
def test_an_xrun_is_never_silent(
    loop: PulseLoop, told: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that stands still for 0.4 s drains every buffer (60 ms): an xrun each time.

    The blocks around it are flagged and the recording is clean again afterwards; or PortAudio's
    ALSA side does not recover (its poll fails), and the stream's end is stated at once. PortAudio
    has no flag for it where the server catches up before the stream looks; its flag is withheld
    to have that case on every machine.
    """
    if not told:
        serve = AudioCallback._serve
        monkeypatch.setattr(
            AudioCallback,
            "_serve",
            lambda self, indata, outdata, frames, xrun: serve(self, indata, outdata, frames, False),
        )
    with SoundCardRig(SETTINGS, LIMITS) as rig:
        sounding(rig)
        os.kill(loop.pid, signal.SIGSTOP)
        try:
            time.sleep(0.4)
        finally:
            os.kill(loop.pid, signal.SIGCONT)
        flags = []
        try:
            for _ in range(12):
                rig.feed()
                flags.append(rig.read(RATE_HZ // 10).flags)
        except DeviceLost:
            assert "device lost" in str(rig.status().fault)
            return
        assert rig.status().xruns >= 1
        assert any("xrun" in one for one in flags)
        assert frozenset() in flags


START_AND_LISTEN = """
from drivers.soundcard import SoundCardRig
from tests.emulators.card import LIMITS, SETTINGS
with SoundCardRig(SETTINGS, LIMITS) as rig:
    rig.start()
    rig.read(12000)
"""


def test_nothing_sounds_at_the_start_though_memory_is_dirty(loop: PulseLoop) -> None:
    """PortAudio began with what it found in memory when given a fixed block size: 1.5e16 here.

    MALLOC_PERTURB_ lets glibc fill every piece of memory with a pattern before it is handed out.
    """
    since = loop.heard().shape[0]
    subprocess.run(
        [sys.executable, "-c", START_AND_LISTEN],
        check=True,
        cwd=ROOT,
        env=os.environ | {"MALLOC_PERTURB_": "165"},
        stderr=subprocess.DEVNULL,
    )
    time.sleep(0.2)
    heard = loop.heard()[since:, 0]
    assert heard.size > 4800
    assert np.all(heard == 0.0)


def test_stopping_ends_in_a_ramp_and_nothing_is_left_for_the_next_start(loop: PulseLoop) -> None:
    """The steepest step of the tone, plus that of the ramp, bounds every step to the end."""
    steepest = (2 * np.pi * 500.0 + 1.0 / LIMITS.silence_ramp_s) / RATE_HZ
    for _ in range(3):
        with SoundCardRig(SETTINGS, LIMITS) as rig:
            sounding(rig)
            since = loop.heard().shape[0]
        time.sleep(0.15)
        heard = loop.heard()[since:, 0].astype(np.float64) * SETTINGS.output_full_scale_v
        assert np.max(np.abs(heard)) > 0.9
        assert np.max(np.abs(np.diff(heard))) <= steepest + 1e-6
        assert heard[-1] == 0.0


def test_silent_while_the_rigs_process_is_frozen(
    loop: PulseLoop, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing feeds the card then, so it plays out what it holds; the reader is told, and the
    process is ended with the rig."""
    monkeypatch.setattr(isolated, "CALL_S", 0.5)
    rig = isolated.IsolatedRig(functools.partial(SoundCardRig, SETTINGS, LIMITS))
    try:
        rig.start()
        rig.drive(Tone(500.0, 1.0))
        rig.read(RATE_HZ // 2)
        since = loop.heard().shape[0]
        os.kill(rig.process_id, signal.SIGSTOP)
        time.sleep(WITHIN_S + 0.3)
        silent_s = loop.sounded_s(since)
        print(f"the rig's process frozen: silent after {silent_s * 1e3:.0f} ms")
        assert silent_s <= WITHIN_S
        with pytest.raises((DeviceLost, DeviceTimeout)):
            rig.read(10 * RATE_HZ, timeout_s=0.5)
        began = time.monotonic()
        rig.close()
        assert time.monotonic() - began < 4.0
    finally:
        rig.close()


def test_a_wedged_server_holds_up_nobody(loop: PulseLoop, monkeypatch: pytest.MonkeyPatch) -> None:
    """PortAudio hangs in its own code then, in the rig's process, which is ended."""
    monkeypatch.setattr(isolated, "CALL_S", 0.5)
    open_card = functools.partial(SoundCardRig, SETTINGS, LIMITS)
    rig = isolated.IsolatedRig(open_card)
    try:
        rig.start()
        rig.read(960)
        os.kill(loop.pid, signal.SIGSTOP)
        began = time.monotonic()
        rig.close()
        # One call that is not answered, 2 s for the process to end by itself, and its end.
        assert time.monotonic() - began < 4.0
        monkeypatch.setattr(isolated, "OPEN_S", 1.0)
        with pytest.raises(DeviceLost, match="did not open its device within"):
            isolated.IsolatedRig(open_card)
        monkeypatch.setattr(discovery, "SEARCH_S", 1.0)
        monkeypatch.setattr(discovery, "FAMILIES", {"sound card": discovery._sound_cards})
        (found,) = discovery.discover()
        assert "no answer within" in str(found.missing)
    finally:
        os.kill(loop.pid, signal.SIGCONT)
        rig.close()


def test_a_lost_server_surfaces_at_once(loop: PulseLoop) -> None:
    """Last, because it ends the module's server."""
    with SoundCardRig(SETTINGS, LIMITS) as rig:
        sounding(rig)
        loop.kill()
        began = time.monotonic()
        with pytest.raises(DeviceLost, match="device lost"):
            rig.read(10 * RATE_HZ, timeout_s=20.0)
        assert time.monotonic() - began < 3.0
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)
        began = time.monotonic()
    assert time.monotonic() - began < 3.0
