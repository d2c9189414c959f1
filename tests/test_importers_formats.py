"""Every recording format: exact round trips, and files that are broken or mean harm."""

import io
import struct
import tracemalloc
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daq.errors import InputError
from daq.exporters import export_folder, export_run
from daq.importers import (
    Recording,
    RecordingOptions,
    import_folder,
    import_recordings,
    open_campaign,
    read_recording,
    recording,
)
from daq.importers.single import select
from daq.store import RunStore
from daq.store_file import open_run, read_volts
from drivers.types import Channel
from identify.load import load_campaign
from tests.daq_folders import write_folder, write_wav

ROOT = Path(__file__).parent.parent
MEASURED = ROOT.parent / "shared" / "measured"
FORMATS = ("wav", "csv", "npz", "mat", "h5", "tdms")


@pytest.fixture
def store(tmp_path: Path) -> RunStore:
    return RunStore(tmp_path / "store")


# -- round trips ---------------------------------------------------------------------------------


@pytest.mark.parametrize("format", FORMATS)
def test_folder_to_store_to_folder_is_exact(format: str, tmp_path: Path, store: RunStore) -> None:
    first = open_campaign(write_folder(tmp_path / "small"), store)
    exported = export_folder(store, first.name, tmp_path / f"as-{format}", format)  # type: ignore[arg-type]
    second = open_campaign(exported, store)
    before, after = load_campaign(first), load_campaign(second)
    assert [run.role for run in before.runs] == [run.role for run in after.runs]
    assert before.medium == after.medium
    assert before.declared_model == after.declared_model
    for one, other in zip(before.runs, after.runs, strict=True):
        assert (one.kind, one.frequency_hz, one.amplitude_v) == (
            other.kind,
            other.frequency_hz,
            other.amplitude_v,
        )
        assert one.sample_rate_hz == other.sample_rate_hz
        for name, signal in one.signals.items():
            np.testing.assert_array_equal(signal.values, other.signals[name].values)


@pytest.mark.parametrize("format", FORMATS)
@settings(
    max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(seed=st.integers(0, 10_000), frames=st.integers(2, 300), width=st.integers(1, 5))
def test_float_samples_come_back_exactly(
    format: str,
    tmp_path_factory: pytest.TempPathFactory,
    seed: int,
    frames: int,
    width: int,
) -> None:
    """float32 volts and a full scale of 8 V, a power of two: exact also as float WAV."""
    folder = tmp_path_factory.mktemp("f")
    rng = np.random.default_rng(seed)
    volts = rng.normal(0, 2, (frames, width)).astype(np.float32)
    write_wav(folder / "in.wav", volts / np.float32(8.0), 1000.0, tag=3)
    channels = tuple(Channel(f"c{i}", "voltage", "V", full_scale_v=8.0) for i in range(width))
    store = RunStore(folder / "store")
    options = RecordingOptions(channels, sample_rate_hz=1000.0)
    card = import_recordings([folder / "in.wav"], options, store)
    (run,) = store.campaign_runs(card.id)
    export_run(store.run_path(run.id), folder / f"out.{format}")
    back = read_recording(folder / f"out.{format}", [channel.name for channel in channels])
    back_volts = back.samples * (back.volts_per_count(8.0) if format == "wav" else 1.0)
    assert back.sample_rate_hz in (None, pytest.approx(1000.0))
    np.testing.assert_array_equal(back_volts, volts.astype(np.float64))
    with open_run(store.run_path(run.id)) as file:
        np.testing.assert_array_equal(read_volts(file), volts)
    store.close()


# -- what other programs write -------------------------------------------------------------------


def test_csv_dialects(tmp_path: Path) -> None:
    expected = [[1.5, -2.0], [3.25, 4.0], [1e-3, 0.0]]
    texts = {
        "plain": "1.5,-2\n3.25,4\n1e-3,0\n",
        "names": "p1,p2\n1.5,-2\n3.25,4\n1e-3,0\n",
        "trailing": "1.5,-2,\n3.25,4,\n1e-3,0,\n",
        "semicolons, decimal commas": "p1;p2\n1,5;-2\n3,25;4\n1e-3;0\n",
        "tabs": "1.5\t-2\n3.25\t4\n1e-3\t0\n",
        "blanks": "  1.5  -2\n 3.25   4\n1e-3 0\n",
        "comments": "# made by a machine\n1.5,-2\n3.25,4\n1e-3,0\n",
        "byte order mark, CRLF": "\ufeffp1,p2\r\n1.5,-2\r\n3.25,4\r\n1e-3,0\r\n",
        "time": "time (s),p1,p2\n0,1.5,-2\n0.001,3.25,4\n0.002,1e-3,0\n",
    }
    for name, text in texts.items():
        path = tmp_path / "x.csv"
        path.write_bytes(text.encode())
        found = read_recording(path)
        np.testing.assert_array_equal(found.samples, expected, err_msg=name)
        if name == "time":
            assert found.sample_rate_hz == pytest.approx(1000.0)


def test_columns_are_picked_by_name_and_number(tmp_path: Path, store: RunStore) -> None:
    t = np.arange(200) / 100.0
    table = np.stack([t, np.sin(t), np.cos(t)], axis=1)
    np.savetxt(tmp_path / "x.txt", table, delimiter="\t", header="time\tphoto\tp", comments="")
    channel = Channel("p", "pressure", "Pa", 0.01)
    for columns in (("p",), (1,)):
        options = RecordingOptions((channel,), columns=columns)
        card = import_recordings([tmp_path / "x.txt"], options, store)
        run = load_campaign(store.campaign_dir(card.id)).runs[0]
        np.testing.assert_allclose(run.signals["p"].values, np.cos(t) / 0.01, rtol=1e-15)
        assert run.sample_rate_hz == pytest.approx(100.0)
    with pytest.raises(InputError, match="column 7 is not one of its 2"):
        import_recordings([tmp_path / "x.txt"], RecordingOptions((channel,), (7,)), store)


PAIR = (Channel("a", "voltage", "V"), Channel("b", "voltage", "V"))


def test_columns_asked_for_are_those_delivered(tmp_path: Path) -> None:
    """A wrong name had been ignored, and the file's own order taken."""
    csv, twice = tmp_path / "x.csv", tmp_path / "twice.csv"
    csv.write_text("left,right\n1,2\n3,5\n")
    twice.write_text("V,V\n1,2\n3,5\n")
    write_wav(tmp_path / "x.wav", np.arange(8, dtype=np.int16).reshape(4, 2))
    np.savez(tmp_path / "x.npz", table=np.arange(8.0).reshape(4, 2))

    def picked(path: Path, *columns: int | str) -> Recording:
        return select(path, RecordingOptions(PAIR, columns))

    found = picked(csv, "right", "left")
    assert found.names == ("right", "left")
    np.testing.assert_array_equal(found.samples, [[2, 1], [5, 3]])
    np.testing.assert_array_equal(picked(tmp_path / "x.wav", 1, 0).samples[0], [1, 0])
    np.testing.assert_array_equal(picked(tmp_path / "x.npz", "table").samples[0], [0, 1])
    with pytest.raises(InputError, match="no column 'rihgt'; there are left, right"):
        picked(csv, "rihgt", "left")
    with pytest.raises(InputError, match="2 columns are named 'V'"):
        picked(twice, "V", "V")
    for name in ("x.wav", "x.npz"):
        with pytest.raises(InputError, match=r"its columns have no names: give numbers from 0"):
            picked(tmp_path / name, "right", "left")


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (RecordingOptions(PAIR, kind="forced"), "a forced run needs frequency_hz"),
        (
            RecordingOptions(PAIR, kind="forced", frequency_hz=1000.0),
            "frequency_hz=1000.0 is not below half the sample rate, 1000 Hz",
        ),
        (RecordingOptions(PAIR, kind="forced", frequency_hz=-1.0), "frequency_hz=-1.0"),
        (RecordingOptions(PAIR, kind="cold", frequency_hz=50.0, amplitude_v=-1.0), "amplitude_v"),
        (RecordingOptions(PAIR, frequency_hz=50.0), "frequency_hz=50.0 is not for a free run"),
        (RecordingOptions(PAIR, sample_rate_hz=0.0), "sample_rate_hz=0"),
        (RecordingOptions(PAIR, kind="cold", frequency_hz=50.0, amplitude_v=1e300), "to 10000 V"),
        (RecordingOptions(PAIR[:1]), "2 columns for 1"),
        (RecordingOptions(PAIR), "constant"),  # the second file: found while it is written
    ],
)
def test_a_refused_recording_leaves_nothing(
    options: RecordingOptions, says: str, tmp_path: Path, store: RunStore
) -> None:
    """A campaign had stayed behind that was never imported to its end."""
    good = np.arange(200, dtype=np.int16).reshape(100, 2)
    write_wav(tmp_path / "good.wav", good)
    write_wav(tmp_path / "dead.wav", good * np.array([1, 0], dtype=np.int16))
    with pytest.raises(InputError, match=says):
        import_recordings([tmp_path / "good.wav", tmp_path / "dead.wav"], options, store)
    assert store.campaigns() == []
    assert store.runs() == []
    assert list(store.campaigns_dir.iterdir()) == []


def test_the_line_at_fault_is_named_in_our_words(tmp_path: Path) -> None:
    """NumPy had advised `usecols`, and a value missing at the first line's end cost a column."""
    path = tmp_path / "x.csv"
    for text, says in (
        ("", "no line of numbers, the file is empty; a table has"),
        ("# nothing\n", "no line of numbers; a table has"),
        ("# made here\na,b\n1,2\n\n3,4,5\n", "line 5 has 3 columns where 2 were expected"),
        ("1,2\n3\n", "line 2 has 1 columns where 2 were expected"),
        ("1,2,\n3,4,5\n", "line 2 has 3 columns where 2 were expected"),
        ("1;2\n3;\n", "line 2: '' is not a number; correct it"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=says) as caught:
            read_recording(path)
        assert str(path) in str(caught.value)
        assert "usecols" not in str(caught.value)


def test_matlab_73_is_read_as_what_it_is(tmp_path: Path) -> None:
    """MATLAB writes a column vector as (1, n) to HDF5, behind a 512-byte header of its own."""
    path = tmp_path / "x.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["p1"] = np.arange(50.0)[None, :]
        file["p2"] = 2 * np.arange(50.0)[None, :]
        file["fs"] = np.array([[2000.0]])
    with path.open("r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + struct.pack("<HH", 0x0200, 0x4D49))
    found = read_recording(path, ["p2", "p1"])
    np.testing.assert_array_equal(found.samples, np.stack([2 * np.arange(50), np.arange(50)], 1))
    assert found.sample_rate_hz == 2000.0


def test_24_bit_wav(tmp_path: Path) -> None:
    values = np.array([[0, 1], [-1, 2**23 - 1], [-(2**23), 77]], dtype=np.int64)
    data = b"".join(int(v).to_bytes(3, "little", signed=True) for v in values.reshape(-1))
    head = struct.pack("<HHIIHH", 1, 2, 48_000, 48_000 * 6, 6, 24)
    body = (
        b"WAVEfmt " + struct.pack("<I", 16) + head + b"data" + struct.pack("<I", len(data)) + data
    )
    (tmp_path / "x.wav").write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
    found = read_recording(tmp_path / "x.wav")
    np.testing.assert_array_equal(found.samples, values)
    assert found.volts_per_count(10.0) == 10.0 / 2**23


@pytest.mark.shared
@pytest.mark.skipif(not MEASURED.exists(), reason="../shared/measured is not here")
def test_measured_recordings_are_read() -> None:
    silverbox = read_recording(MEASURED / "silverbox" / "SNLS80mV.csv")
    assert silverbox.samples.shape == (131_072, 2)
    combustor = read_recording(MEASURED / "combustor" / "p16.txt")
    assert combustor.samples.shape[0] == 30_000
    tube = read_recording(MEASURED / "impedance_tube" / "empty_00_11_22_33_44_55.h5")
    assert tube.samples.shape == (51_200, 6)
    assert tube.sample_rate_hz == 51_200.0


# -- broken and hostile --------------------------------------------------------------------------


def _npz_bomb(path: Path) -> None:
    """256 MiB of zeros behind 256 KiB of zip; the test lowers the limit to 64 MiB."""
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (2**25,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("p1.npy", header.getvalue() + b"\0" * 2**28)


def _npz_lying_header(path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)}
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("p1.npy", header.getvalue() + b"\0" * 800)


def _npz_pickle(path: Path) -> None:
    np.savez(path, p1=np.array([print, print], dtype=object))


def _wav_10_gb_header(path: Path) -> None:
    head = struct.pack("<HHIIHH", 1, 2, 1000, 4000, 4, 16)
    path.write_bytes(
        b"RIFF" + struct.pack("<I", 0xFFFFFFF0) + b"WAVEfmt " + struct.pack("<I", 16) + head
        + b"data" + struct.pack("<I", 0xFFFFFFF0) + b"\0" * 64
    )  # fmt: skip


def _wav_zero_channels(path: Path) -> None:
    head = struct.pack("<HHIIHH", 1, 0, 1000, 4000, 0, 16)
    body = b"WAVEfmt " + struct.pack("<I", 16) + head + b"data" + struct.pack("<I", 4) + b"\0" * 4
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)


def _h5_external(path: Path) -> None:
    (path.parent / "secret.bin").write_bytes(b"\1" * 800)
    with h5py.File(path, "w") as file:
        file.create_dataset(
            "p1", (100,), "f8", external=[(str(path.parent / "secret.bin"), 0, 800)]
        )


def _h5_huge(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file.create_dataset("p1", (10**11,), "f8", chunks=(10**6,))


def _h5_unreadable(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["p1"] = np.arange(1e5)
    path.write_bytes(path.read_bytes()[: 2**15])


def _mat_truncated(path: Path) -> None:
    scipy.io.savemat(path, {"p1": np.arange(1e4)})
    path.write_bytes(path.read_bytes()[:1000])


def _mat_strings(path: Path) -> None:
    scipy.io.savemat(path, {"p1": "hello"})


def _unequal(path: Path) -> None:
    np.savez(path, p1=np.arange(10.0), p2=np.arange(11.0))


def _complex(path: Path) -> None:
    np.savez(path, p1=np.arange(10.0) * 1j)


def _tdms_cut(path: Path) -> None:
    path.write_bytes(b"TDSm" + b"\xff" * 40)


HOSTILE = {
    "bomb.npz": (_npz_bomb, "declares 0.3 GiB"),
    "lying.npz": (_npz_lying_header, "declares shape"),
    "pickle.npz": (_npz_pickle, "pickled objects"),
    "unequal.npz": (_unequal, "unequal length"),
    "complex.npz": (_complex, "not real numbers"),
    "cut.npz": (lambda p: p.write_bytes(b"PK\3\4garbage"), "not a readable NumPy archive"),
    "huge.wav": (_wav_10_gb_header, "truncated"),
    "none.wav": (_wav_zero_channels, "do not fit together"),
    "external.h5": (_h5_external, "in another file"),
    "huge.h5": (_h5_huge, "GiB"),
    "cut.h5": (_h5_unreadable, "not a readable HDF5 file"),
    "text.h5": (lambda p: p.write_bytes(b"no"), "not a readable HDF5 file"),
    "cut.mat": (_mat_truncated, "not a readable MATLAB file"),
    "strings.mat": (_mat_strings, "not real numbers|holds no array"),
    "not.mat": (lambda p: p.write_bytes(b"x" * 300), "version 5 or 7.3"),
    "cut.tdms": (_tdms_cut, "not a readable TDMS file|0 channels match"),
    "not.tdms": (lambda p: p.write_bytes(b"x" * 300), "not a TDMS file"),
    "words.csv": (lambda p: p.write_text("a,b\n1,2\n3,four\n"), "four"),
    "ragged.csv": (lambda p: p.write_text("1,2\n3,4,5\n"), "not a table|columns"),
    "binary.csv": (lambda p: p.write_bytes(b"1,2\n\0\0\0"), "binary content"),
    "empty.csv": (lambda p: p.write_text(""), "no line of numbers"),
    "jump.csv": (lambda p: p.write_text("time,p\n0,1\n1,2\n9,3\n"), "not uniform"),
    "oneline.csv": (lambda p: p.write_text("1," * 100_000), "longer than"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_broken_and_hostile_files_are_refused(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Refused by name, and without unpacking more than the limit on memory (64 MiB here)."""
    monkeypatch.setattr(recording, "MAX_BYTES", 2**26)
    make, message = HOSTILE[name]
    make(tmp_path / name)
    tracemalloc.start()
    with pytest.raises(InputError, match=message) as caught:
        read_recording(tmp_path / name, [] if name == "unequal.npz" else ["p1"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert name in str(caught.value)
    assert peak < 2**26


@pytest.mark.parametrize("suffix", ["wav", "npz", "mat", "h5", "tdms", "csv"])
@settings(
    max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_bytes_flipped_anywhere_never_crash(
    suffix: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """A damaged file is read (the damage was in the samples) or refused; nothing else happens."""
    folder = tmp_path_factory.mktemp("flip")
    source = _samples(folder, suffix)
    content = bytearray(source)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, min(len(content) - 1, 1500)))] ^= data.draw(
            st.integers(1, 255)
        )
    path = folder / f"x.{suffix}"
    path.write_bytes(content[: data.draw(st.integers(1, len(content)))])
    try:
        found = read_recording(path)
    except InputError:
        return
    assert found.samples.ndim == 2


_CACHE: dict[str, bytes] = {}


def _samples(folder: Path, suffix: str) -> bytes:
    """A small valid file of that format."""
    if suffix not in _CACHE:
        store = RunStore(folder / "s")
        write_wav(folder / "in.wav", np.arange(-50, 50, dtype=np.int16).reshape(50, 2), 1000.0)
        channels = (Channel("a", "voltage", "V"), Channel("b", "voltage", "V"))
        card = import_recordings([folder / "in.wav"], RecordingOptions(channels), store)
        (run,) = store.campaign_runs(card.id)
        export_run(store.run_path(run.id), folder / f"ok.{suffix}")
        _CACHE[suffix] = (folder / f"ok.{suffix}").read_bytes()
        store.close()
    return _CACHE[suffix]


def test_folder_of_csv_without_names(tmp_path: Path, store: RunStore) -> None:
    """The column order is then the channels' order."""
    folder = write_folder(tmp_path / "small")
    for path in sorted((folder / "runs").glob("*.wav")):
        recording = read_recording(path)
        np.savetxt(path.with_suffix(".csv"), recording.samples / 32768.0, delimiter=",")
        path.unlink()
    toml = folder / "campaign.toml"
    toml.write_text(toml.read_text().replace(".wav", ".csv"))
    card = import_folder(folder, store)
    assert len(store.campaign_runs(card.id)) == 4
