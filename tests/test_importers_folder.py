"""Campaign folders: what is read is what was written, and what cannot be used is refused."""

import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path

import numpy as np
import pytest

from daq.errors import InputError, StoreError, UnknownItem
from daq.importers import Recording, folder, import_folder, open_campaign, read_recording, whole
from daq.records import CampaignCard
from daq.store import RunStore
from identify.load import LoadError, load_campaign
from tests.daq_folders import CHANNELS, int16, tones, write_folder, write_wav

SHARED = Path(__file__).parent.parent.parent / "shared" / "cases"


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "store")


def test_folder_arrives_in_physical_units(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "small")
    campaign = load_campaign(open_campaign(folder, store))
    assert [run.kind for run in campaign.runs] == ["free", "forced", "forced", "forced"]
    assert [run.role for run in campaign.runs] == ["fit", "fit", "fit", "validation"]
    run = campaign.runs[1]
    assert (run.frequency_hz, run.amplitude_v, run.started_s) == (166.0, 1.5, 60.0)
    counts = int16(tones(166.0, 1.5))
    # Full scale is 32768 counts: 10 V at 2 mV/Pa, 5 V at 4 mV/Pa, 10 V.
    for column, (name, scale) in enumerate(
        [("p1", 10 / 32768 / 0.002), ("p2", 5 / 32768 / 0.004), ("drive", 10 / 32768)]
    ):
        signal = run.signals[name]
        np.testing.assert_allclose(signal.values, counts[:, column] * scale, rtol=1e-14)
        assert signal.resolution == pytest.approx(scale, rel=1e-14)
    assert run.signals["p1"].full_scale == pytest.approx(5000.0)
    assert run.signals["p2"].position_m == 0.71
    assert run.signals["drive"].unit == "V"


def test_fewer_bits_than_the_file_s_are_seen(tmp_path: Path, store: RunStore) -> None:
    """Twelve bits, left-justified in sixteen: the tops of a sine had been taken for clipping."""
    folder = write_folder(tmp_path / "twelve")
    counts = int16(tones(166.0, 1.5))
    write_wav(folder / "runs/f166.wav", (counts // 16 * 16).astype(np.int16))
    signal = load_campaign(open_campaign(folder, store)).runs[1].signals["p1"]
    assert signal.resolution == pytest.approx(16 * 10 / 32768 / 0.002, rel=1e-14)


def test_float_wav_counts_full_scale_as_one(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "floats")
    volts = tones(166.0, 1.5)
    write_wav(
        folder / "runs/f166.wav", (volts / np.array([10.0, 5.0, 10.0])).astype(np.float32), tag=3
    )
    signal = load_campaign(open_campaign(folder, store)).runs[1].signals["p2"]
    # float32 keeps 24 bits: relative rounding at most 2^-24 of the sample itself
    np.testing.assert_allclose(signal.values, volts[:, 1] / 0.004, rtol=2**-23, atol=1e-30)
    assert signal.resolution is None


def test_importing_again_finds_the_first(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "small")
    first = import_folder(folder, store)
    assert import_folder(folder, store) == first
    write_wav(folder / "runs/f166.wav", int16(tones(166.0, 1.25)))
    assert import_folder(folder, store).id != first.id
    assert len(store.campaigns()) == 2


def _at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, patience_s: float
) -> tuple[CampaignCard, Future[CampaignCard]]:
    """Two imports of one folder: the first stands still while it reads its third recording, until
    the second has ended, or has not within `patience_s`."""
    path = write_folder(tmp_path / "small")
    half, go_on = threading.Event(), threading.Event()

    def reading(file: Path, wanted: Sequence[str] = ()) -> Recording:
        if file.name == "f172.wav" and not half.is_set():
            half.set()
            assert go_on.wait(30)
        return read_recording(file, wanted)

    monkeypatch.setattr(folder, "read_recording", reading)
    with ThreadPoolExecutor(2) as workers:
        first = workers.submit(import_folder, path, RunStore(tmp_path / "store"))
        assert half.wait(20)
        second = workers.submit(import_folder, path, RunStore(tmp_path / "store"))
        wait([second], patience_s)
        go_on.set()
    return first.result(), second


def test_two_imports_at_once_make_one_campaign(
    tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second had removed what the first was writing, and then what it had written."""
    first, second = _at_once(tmp_path, monkeypatch, 0.3)
    assert second.result() == first
    assert len(store.campaign_runs(first.id)) == len(store.runs()) == 4
    assert [path.name for path in store.campaigns_dir.iterdir()] == [first.id]
    assert not list(store.root.glob(".*importing"))


def test_an_import_that_takes_long_refuses_another(
    tmp_path: Path, store: RunStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(whole, "WAIT_S", 0.0)
    first, second = _at_once(tmp_path, monkeypatch, 20.0)
    with pytest.raises(StoreError, match="is being imported by another process; try again"):
        second.result()
    assert store.card(first.id).status == "complete"
    assert len(store.campaign_runs(first.id)) == 4


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="no SIGKILL here")
def test_an_import_that_was_killed_blocks_nobody(tmp_path: Path, store: RunStore) -> None:
    path = write_folder(tmp_path / "small")
    code = """
import os, signal, sys
from pathlib import Path
from daq.importers import folder
from daq.store import RunStore
read = folder.read_recording
def killed(file, wanted=()):
    if file.name == "f172.wav":
        os.kill(os.getpid(), signal.SIGKILL)
    return read(file, wanted)
folder.read_recording = killed
folder.import_folder(Path(sys.argv[1]), RunStore(sys.argv[2]))
"""
    done = subprocess.run([sys.executable, "-c", code, str(path), str(store.root)])
    assert done.returncode == -signal.SIGKILL
    assert [row.status for row in store.campaigns()] == ["importing"]
    assert list(store.root.glob(".*importing"))
    card = import_folder(path, store)
    assert (card.status, len(store.campaign_runs(card.id))) == ("complete", 4)
    assert not list(store.root.glob(".*importing"))


def test_defaults_of_medium_and_model(tmp_path: Path, store: RunStore) -> None:
    campaign = load_campaign(open_campaign(write_folder(tmp_path / "small"), store))
    assert (campaign.medium.density_kg_m3, campaign.medium.sound_speed_m_s) == (1.2, 343.0)
    assert campaign.declared_model.modes == 2
    assert campaign.declared_model.nonlinearity_degree == 3


def test_an_id_is_looked_up_and_a_missing_one_named(tmp_path: Path, store: RunStore) -> None:
    card = import_folder(write_folder(tmp_path / "small"), store)
    assert open_campaign(card.id, store) == store.campaign_dir(card.id)
    for wrong in ("nowhere", "../store", ""):
        with pytest.raises(UnknownItem, match="campaign"):
            open_campaign(wrong, store)
    with pytest.raises(LoadError, match=r"campaign\.json"):
        load_campaign(tmp_path)


def _nan(folder: Path) -> None:
    samples = tones(166.0, 1.5).astype(np.float32)
    samples[123, 1] = np.nan
    write_wav(folder / "runs/f166.wav", samples, tag=3)


def _column(column: int, value: int) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        samples = int16(tones(166.0, 1.5))
        samples[:, column] = value
        write_wav(folder / "runs/f166.wav", samples)

    return spoil


def _truncate(folder: Path) -> None:
    path = folder / "runs/f166.wav"
    path.write_bytes(path.read_bytes()[:-100])


def _edit(pattern: str, replacement: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        path = folder / "campaign.toml"
        text, count = re.subn(pattern, replacement, path.read_text(), count=1)
        assert count == 1
        path.write_text(text)

    return spoil


BAD = {
    "missing file": (lambda f: (f / "runs/f166.wav").unlink(), r"runs/f166\.wav.*no such file"),
    "missing toml": (lambda f: (f / "campaign.toml").unlink(), r"campaign\.toml: no such file"),
    "not toml": (_edit("format", "= format"), "not TOML"),
    "wrong format": (_edit("campaign-folder/1", "campaign-folder/9"), "campaign-folder/9"),
    "unknown key": (_edit("title", 'colour = "red"\ntitle'), "unknown key colour='red'"),
    "unknown run key": (_edit("started_s = 60", "startd = 60"), r"unknown key runs\[1\]\.startd"),
    "wrong rate": (_edit("2000.0", "2500.0"), "2000 Hz.*sample_rate_hz=2500"),
    "no forced run": (
        lambda f: write_folder(f, runs='[[runs]]\nfile="runs/free.wav"\nkind="free"\n'),
        "no forced run",
    ),
    "no drive": (_edit('name = "drive"', 'name = "horn"'), "no channel named 'drive'"),
    "columns": (
        lambda f: write_wav(f / "runs/f166.wav", int16(tones(166.0, 1.5))[:, :2]),
        r"f166\.wav: 2 columns for 3",
    ),
    "nan": (_nan, r"f166\.wav: channel 'p2' is nan at sample 123 \(0\.0615 s\)"),
    "constant": (_column(0, 77), r"f166\.wav: channel 'p1' is constant at 77"),
    "zero": (_column(1, 0), r"f166\.wav: channel 'p2' is constant at 0"),
    "silent drive": (_column(2, 0), r"f166\.wav: a forced run whose drive"),
    "truncated": (_truncate, r"f166\.wav.*truncated"),
    "not a wav": (lambda f: (f / "runs/f166.wav").write_bytes(b"hello"), "not a WAV file"),
    "empty file": (lambda f: (f / "runs/f166.wav").write_bytes(b""), "not a WAV file"),
    "path out": (_edit("runs/f166.wav", "../f166.wav"), "outside the campaign folder"),
    "absolute path": (_edit("runs/f166.wav", "/etc/hostname"), "outside the campaign folder"),
    "negative rate": (_edit("2000.0", "-1.0"), "sample_rate_hz=-1.0"),
    "no frequency": (_edit("frequency_hz = 166.0\n", ""), "f166.*needs frequency_hz"),
    "above nyquist": (_edit("166.0", "1166.0"), "frequency_hz=1166"),
    "zero sensitivity": (_edit("= 0.002", "= 0.0"), "'p1'.*volts_per_unit=0"),
    "millipascal": (
        _edit('"Pa"', '"mPa"'),
        r"'p1': unit='mPa' is not SI; give unit 'Pa' and volts_per_unit=2$",
    ),
    "decibels": (_edit('"Pa"', '"dB"'), "'p1': unit='dB' is no unit of samples"),
    "a broadband recording": (
        _edit(r"\[\[channels\]\]", '[excitation]\nkind = "broadband"\n[[channels]]'),
        r"only `entrain diagnose` takes a folder with \[excitation\]",
    ),
    "a link to itself": (
        lambda f: (
            (f / "runs/f166.wav").unlink(),
            (f / "runs/f166.wav").symlink_to(f / "runs/f166.wav"),
        ),
        r"run file 'runs/f166\.wav': Symlink loop",
    ),
    "a folder": (_edit(r"runs/f166\.wav", "runs"), r"runs: is a folder: give a file"),
    "deep": (_edit("title", f"a = {5000 * '['}\ntitle"), "not TOML: nested too deeply"),
    "utf-16": (
        lambda f: (f / "campaign.toml").write_bytes(
            (f / "campaign.toml").read_text("utf-8").encode("utf-16")
        ),
        "save it as UTF-8",
    ),
    "a dot": (_edit('"p1"', '"."'), r"channel name='\.' is not printable text"),
    "far away": (_edit("0.66", "-1e9"), "channel 'p1': position_m=-1000000000.0 is not a place"),
    "one place": (_edit("0.66", "0.71"), r"p1, p2 are all at position_m=0\.71"),
    "a drive of 1e300 V": (
        _edit(r"amplitude_v = 1\.5", "amplitude_v = 1e300"),
        "amplitude_v=1e.300",
    ),
    "before the world": (_edit("started_s = 60", "started_s = -1e30"), r"started_s=-1e.30"),
    "a long title": (_edit('title = "', f'title = "{300 * "x"}'), "at most 200 characters"),
    "a fast converter": (_edit("2000.0", "1e300"), "sample_rate_hz=1e.300"),
    "a dragon": (
        _edit("title", 'declared_model = {flame = "dragon"}\ntitle'),
        r"declared_model\.flame='dragon': Input should be 'none'",
    ),
    "twice p1": (_edit('"p2"', '"p1"'), "named twice: p1"),
    "unknown kind": (_edit('"free"', '"warm"'), r"runs\[0\]\.kind='warm'"),
    "unknown suffix": (
        lambda f: (
            (f / "runs/f166.wav").rename(f / "runs/f166.mp3"),
            _edit(r"f166\.wav", "f166.mp3")(f),
        ),
        r"format '\.mp3' is not one of",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_unusable_folders_are_refused_and_leave_nothing(
    what: str, tmp_path: Path, store: RunStore
) -> None:
    spoil, message = BAD[what]
    folder = write_folder(tmp_path / "small")
    spoil(folder)
    with pytest.raises(InputError, match=message):
        import_folder(folder, store)
    assert store.campaigns() == []
    assert store.runs() == []
    assert list(store.campaigns_dir.iterdir()) == []


def test_a_byte_order_mark_is_read_over(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "small")
    path = folder / "campaign.toml"
    path.write_text(path.read_text("utf-8"), "utf-8-sig")
    assert import_folder(folder, store).status == "complete"


def test_link_out_of_the_folder_is_refused(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "small")
    outside = tmp_path / "secret.wav"
    (folder / "runs/f166.wav").rename(outside)
    (folder / "runs/f166.wav").symlink_to(outside)
    with pytest.raises(InputError, match="outside the campaign folder"):
        import_folder(folder, store)


def test_free_run_may_have_a_silent_drive_only(tmp_path: Path, store: RunStore) -> None:
    folder = write_folder(tmp_path / "small", channels=CHANNELS)
    samples = int16(tones(170.0, 0.0))
    samples[:, 0] = 0
    write_wav(folder / "runs/free.wav", samples)
    with pytest.raises(InputError, match=r"free\.wav: channel 'p1' is constant"):
        import_folder(folder, store)


@pytest.mark.shared
@pytest.mark.skipif(not SHARED.exists(), reason="../shared/cases is not here")
def test_recorded_cases_open(store: RunStore) -> None:
    """How fast: ``benchmarks/store_speed.py``."""
    for case in ("a-clean", "b-flame-delay"):
        campaign = load_campaign(open_campaign(SHARED / case, store))
        assert len(campaign.runs) == 11
        assert campaign.runs[1].signals["p1"].values.size == 20_000
