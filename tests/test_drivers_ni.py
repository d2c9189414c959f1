"""The NI driver without a card: the library's own signatures, and its errors without a driver."""

import shutil
from pathlib import Path

import pytest

from drivers import ni
from drivers.errors import DeviceLost, MissingDependency, SettingError
from drivers.ni import NiRig, NiSettings
from drivers.types import Channel, OutputLimits, Tone
from tests.contract import LIMITS, RigContract

nidaqmx = pytest.importorskip("nidaqmx", reason="nidaqmx missing: pip install 'entrain[ni]'")

from drivers.ni_library import daqmx, translated  # noqa: E402
from tests.emulators.daqmx import Card  # noqa: E402

SETTINGS = NiSettings(
    device="Dev1",
    channels=(
        Channel("drive", "voltage", "V", full_scale_v=5.0),
        Channel("mic", "pressure", "Pa", volts_per_unit=0.05, full_scale_v=5.0),
    ),
    inputs=("ai0", "ai1"),
    sample_rate_hz=8000.0,
    block_frames=64,
)


@pytest.fixture
def card(monkeypatch: pytest.MonkeyPatch) -> Card:
    card = Card()
    monkeypatch.setattr(ni, "daqmx", card.library)
    return card


class TestNiContract(RigContract):
    drive_column = 0
    noise_v = 1e-9
    latency_s = 0.05

    @pytest.fixture(autouse=True)
    def _card(self, card: Card) -> None:
        self.card = card

    def open_rig(self, limits: OutputLimits) -> NiRig:
        return NiRig(SETTINGS, limits)


def test_the_rate_is_the_one_that_the_device_coerced_to(card: Card) -> None:
    settings = NiSettings("Dev1", SETTINGS.channels, SETTINGS.inputs, sample_rate_hz=12_000.0)
    with NiRig(settings, LIMITS) as rig:
        rig.start()
        assert rig.sample_rate_hz == 16_000.0


def test_the_output_holds_zero_after_stop_and_close(card: Card) -> None:
    """An analogue output keeps its last value when its task ends: that has to be zero."""
    rig = NiRig(SETTINGS, LIMITS)
    rig.start()
    rig.drive(Tone(170.0, 1.0))
    while rig.status().output_v < 1.0:
        rig.feed()
        rig.read(64)
    rig.close()
    assert card.held_v == 0.0
    assert card.open_tasks == []


def test_a_channel_that_is_not_there_is_refused_and_nothing_stays_open(card: Card) -> None:
    settings = NiSettings("Dev1", SETTINGS.channels, ("ai0", "ai9"), sample_rate_hz=8000.0)
    with NiRig(settings, LIMITS) as rig:
        with pytest.raises(SettingError, match="Physical channel specified does not exist"):
            rig.start()
        assert not rig.status().running
    assert card.open_tasks == []


def test_unplugging_is_a_lost_device(card: Card) -> None:
    with NiRig(SETTINGS, LIMITS) as rig:
        rig.start()
        rig.read(64)
        card.unplugged = True
        with pytest.raises(DeviceLost, match=r"Device cannot be accessed.*-201003"):
            rig.read(80_000)
        status = rig.status()
        assert (status.running, status.output_v) == (False, 0.0)
        assert "device lost" in str(status.fault)


def test_without_a_driver_the_error_says_so() -> None:
    if shutil.which("nilsdev") or Path("/usr/lib/x86_64-linux-gnu/libnidaqmx.so").exists():
        pytest.skip("NI-DAQmx is installed here")
    with pytest.raises(MissingDependency, match=r"NI-DAQmx: .*ensure that NI-DAQmx is installed"):
        daqmx()


def test_errors_are_sorted_by_code() -> None:
    error = nidaqmx.errors.DaqError("Timed out.\nTask: x", -200284)
    assert str(translated(error)) == "Timed out. (DAQmx -200284)"


@pytest.mark.parametrize(
    ("change", "parameter"),
    [
        ({"inputs": ("ai0",)}, "inputs"),
        ({"sample_rate_hz": 0.0}, "sample_rate_hz"),
        ({"block_frames": 4}, "block_frames"),
        ({"lead_blocks": 1}, "lead_blocks"),
    ],
)
def test_bad_settings_name_the_parameter(change: dict[str, object], parameter: str) -> None:
    known = {"device": "Dev1", "channels": SETTINGS.channels, "inputs": SETTINGS.inputs}
    with pytest.raises(SettingError, match=parameter):
        NiSettings(**{**known, **change})  # type: ignore[arg-type]
