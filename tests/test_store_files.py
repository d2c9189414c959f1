"""Run files: raw samples come back bit for bit, outcomes are honest, the catalogue is an index."""

import contextlib
import hashlib
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from daq.errors import CorruptFile, StoreError, UnknownItem
from daq.records import RunHeader, RunSummary
from daq.store import RunStore
from daq.store_catalogue import Catalogue, RunQuery
from daq.store_file import open_run, read_gaps, read_header, read_summary, read_volts
from daq.store_writer import RunWriter, partial_path
from drivers.types import Channel, Gap
from identify.load import load_run

CHANNELS = (
    Channel("p1", "pressure", "Pa", 0.002, 10.0, 0.66, "SN1"),
    Channel("drive", "voltage", "V"),
)


def header(name: str = "000-run", **changes: object) -> RunHeader:
    fields = {"kind": "forced", "frequency_hz": 166.0, "amplitude_v": 1.5, "rig": "bench"}
    return RunHeader(name=name, sample_rate_hz=1000.0, channels=CHANNELS, **{**fields, **changes})  # type: ignore[arg-type]


@settings(
    max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    blocks=st.lists(st.integers(1, 300), min_size=1, max_size=6),
    dtype=st.sampled_from(["int16", "float32", "float64"]),
    seed=st.integers(0, 2**31),
)
def test_samples_come_back_bit_for_bit(
    tmp_path_factory: pytest.TempPathFactory, blocks: list[int], dtype: str, seed: int
) -> None:
    path = tmp_path_factory.mktemp("runs") / "run.h5"
    samples = (np.random.default_rng(seed).normal(0, 1000, (sum(blocks), 2))).astype(dtype)
    writer = RunWriter(path, header(dtype=dtype, volts_per_count=(0.5, 2.0)), "c", durable=False)
    start = 0
    for frames in blocks:
        writer.append(samples[start : start + frames])
        start += frames
    summary = writer.finish()
    with open_run(path) as file:
        np.testing.assert_array_equal(file["entry/data/samples"][()], samples)
        np.testing.assert_array_equal(read_volts(file), samples * np.array([0.5, 2.0]))
        assert read_header(file) == writer.header
    assert summary.sha256 == hashlib.sha256(samples.tobytes()).hexdigest()
    assert summary == read_summary(path, "c")
    assert not partial_path(path).exists()


def test_a_run_is_readable_while_it_grows(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run.h5", header(), "c", flush_s=0.01)
    writer.append(np.ones((500, 2)))
    while writer.queued_bytes:
        pass
    # the flush follows the write at once; the last flushed state is what a reader sees
    with open_run(partial_path(writer.path), live=True) as file:
        assert file["entry"].attrs["exit_status"] == "interrupted"
        assert file["entry/data/samples"].shape[0] in (0, 500)
    writer.append(np.full((500, 2), 2.0))
    assert writer.finish().samples == 1000


def test_lost_frames_are_listed_and_filled(tmp_path: Path) -> None:
    writer = RunWriter(tmp_path / "run.h5", header(), "c")
    writer.append(np.ones((10, 2)), first_frame=100)
    writer.append(np.ones((10, 2)), first_frame=130, flags=frozenset({"gap", "overload"}))
    assert writer.finish().samples == 40
    with open_run(tmp_path / "run.h5") as file:
        assert read_gaps(file) == (Gap(10, 20),)
        assert np.isnan(read_volts(file)[10:30]).all()
        assert np.isfinite(read_volts(file, 30)).all()
        assert file["entry/quality/flags"][()].tolist() == [[30, 10, 1 + 8]]
    assert load_run(tmp_path / "run.h5").notes["gaps"] == [[10, 20]]


def test_time_never_runs_backwards(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "run.h5", header(), "c") as writer:
        writer.append(np.ones((10, 2)), first_frame=100)
        with pytest.raises(StoreError, match="frame 105 cannot follow frame 110"):
            writer.append(np.ones((10, 2)), first_frame=105)


def test_outcome_is_never_success_by_default(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "left.h5", header("left"), "c") as writer:
        writer.append(np.ones((10, 2)))
    with pytest.raises(ZeroDivisionError), RunWriter(tmp_path / "x.h5", header("x"), "c") as writer:
        raise ZeroDivisionError("flame out")
    assert read_summary(tmp_path / "left.h5", "c").exit_status == "aborted"
    failed = read_summary(tmp_path / "x.h5", "c")
    assert (failed.exit_status, failed.exit_reason) == ("failed", "ZeroDivisionError: flame out")


def test_wrong_blocks_are_refused(tmp_path: Path) -> None:
    with RunWriter(tmp_path / "a.h5", header(dtype="int16"), "c") as writer:
        with pytest.raises(StoreError, match="does not have 2 columns"):
            writer.append(np.ones((3, 3), np.int16))
        with pytest.raises(StoreError, match="float64 samples for a int16"):
            writer.append(np.ones((3, 2)))
    with pytest.raises(StoreError, match="never overwritten"):
        RunWriter(tmp_path / "a.h5", header(), "c")


def test_failure_of_the_thread_surfaces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file system is real; only its answer «no space left» is brought about by hand."""
    writer = RunWriter(tmp_path / "run.h5", header(), "c", flush_s=0.0)
    monkeypatch.setattr(
        writer, "_write", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    )
    writer.append(np.ones((10, 2)))
    with pytest.raises(StoreError, match="No space left on device"):
        writer.finish()
    assert partial_path(writer.path).exists()
    assert not writer.path.exists()
    writer.discard()


def test_run_file_is_plain_hdf5(tmp_path: Path) -> None:
    """What MATLAB or xarray would see: groups, units, the signal, numbers."""
    with RunWriter(tmp_path / "run.h5", header(), "c") as writer:
        writer.append(np.ones((4, 2)))
        writer.finish()
    with h5py.File(tmp_path / "run.h5") as file:
        data = file[file.attrs["default"]]
        data = data[data.attrs["default"]]
        samples = data[data.attrs["signal"]]
        assert samples.attrs["units"] == "V"
        assert samples.attrs["sample_rate_hz"] == 1000.0
        assert list(samples.attrs["channels"]) == ["p1", "drive"]
        assert file["entry/instrument/p1"].attrs["serial_number"] == "SN1"
        assert file["entry"].attrs["software_version"]


def test_not_a_run_file(tmp_path: Path) -> None:
    (tmp_path / "junk.h5").write_bytes(b"junk" * 100)
    with pytest.raises(CorruptFile, match=r"junk\.h5"):
        read_summary(tmp_path / "junk.h5", "c")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = 1
    with pytest.raises(CorruptFile, match="format=None"):
        read_summary(tmp_path / "other.h5", "c")
    with pytest.raises(CorruptFile, match="no such run file"):
        read_summary(tmp_path / "none.h5", "c")


def test_campaigns_of_one_title_in_one_second_have_folders_of_their_own(tmp_path: Path) -> None:
    """Two terminals that begin at the same time."""

    def begin(_: int) -> str:
        with contextlib.closing(RunStore(tmp_path / "store")) as store:
            return store.create_campaign("tube").id

    with ThreadPoolExecutor(8) as pool:
        names = list(pool.map(begin, range(24)))
    assert len(set(names)) == 24
    with contextlib.closing(RunStore(tmp_path / "store")) as store:
        assert {card.id for card in store.campaigns()} == set(names)


def test_catalogue_is_rebuilt_from_the_files(tmp_path: Path) -> None:
    store = RunStore(tmp_path / "store")
    card = store.create_campaign("Tube, 4 kW", rig="bench", medium={"density_kg_m3": 1.1})
    for index in range(3):
        with store.write_run(card.id, header(f"{index:03d}")) as writer:
            writer.append(np.ones((5, 2)))
            store.add_run(writer.finish())
    store.set_status(card.id, verdict="traced")
    runs, campaigns = store.runs(), store.campaigns()
    assert len(runs) == 3
    store.close()
    (store.root / "catalogue.sqlite").write_bytes(
        b"not a database at all, overwritten by an accident"
    )
    with pytest.raises(StoreError, match="store rebuild"):
        RunStore(store.root)
    for leftover in store.root.glob("catalogue.sqlite*"):
        leftover.unlink()
    again = RunStore(store.root)
    assert again.runs() == []
    (store.campaigns_dir / card.id / "runs" / "damaged.h5").write_bytes(b"x" * 2000)
    problems = again.rebuild()
    assert len(problems) == 1
    assert "damaged.h5" in problems[0]
    assert (again.runs(), again.campaigns()) == (runs, campaigns)
    assert again.card(card.id).medium == {"density_kg_m3": 1.1}


def test_a_campaign_killed_before_it_began_is_no_problem(tmp_path: Path) -> None:
    store = RunStore(tmp_path / "store")
    runs = store.campaigns_dir / "c000" / "runs"
    runs.mkdir(parents=True)
    assert store.rebuild() == []
    assert store.campaigns() == []
    (runs / "000-free.h5").write_bytes(b"what was recorded")
    assert ["no such campaign" in problem for problem in store.rebuild()] == [True]


def test_names_cannot_leave_the_store(tmp_path: Path) -> None:
    store = RunStore(tmp_path / "store")
    card = store.create_campaign("x")
    for name in ("..", "../..", "", "a/b"):
        with pytest.raises(UnknownItem):
            store.campaign_dir(name)
    with pytest.raises(UnknownItem, match="no run"):
        store.run_path(f"{card.id}/../campaign")


def summary(index: int) -> RunSummary:
    return RunSummary(
        campaign=f"c{index // 1000:04d}",
        name=f"{index % 1000:04d}",
        kind="forced",
        role="fit",
        frequency_hz=160.0 + index % 20,
        amplitude_v=1.0,
        started_s=0.0,
        started_at=f"2026-01-{1 + index % 28:02d}",
        rig=f"rig{index % 7}",
        sample_rate_hz=1e4,
        samples=20_000,
        exit_status="success",
        exit_reason="",
        sha256="0" * 64,
        bytes=1,
    )


def test_pages_follow_each_other_and_filters_hold(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path / "c.sqlite")
    everything = [summary(index) for index in range(2500)]
    catalogue.add_runs(everything)
    seen: list[RunSummary] = []
    while page := catalogue.runs(after=seen[-1].id if seen else None, limit=400):
        seen += page
    assert seen == everything
    query = RunQuery(rig="rig3", min_frequency_hz=165.0, max_frequency_hz=165.5)
    expected = [s for s in everything if s.rig == "rig3" and s.frequency_hz == 165.0]
    assert catalogue.runs(query, limit=10_000) == expected
    assert catalogue.count(query) == len(expected)
    query = RunQuery(campaign="c0001", since="2026-01-05", until="2026-01-06")
    assert {s.started_at for s in catalogue.runs(query)} == {"2026-01-05"}
    catalogue.close()


def test_threads_that_come_and_go_leave_no_connections_behind(tmp_path: Path) -> None:
    path = tmp_path / "c.sqlite"
    catalogue = Catalogue(path)
    held = [fd for fd in Path("/proc/self/fd").iterdir() if fd.resolve() == path]
    for _ in range(30):
        thread = threading.Thread(target=catalogue.runs)
        thread.start()
        thread.join()
    assert [fd for fd in Path("/proc/self/fd").iterdir() if fd.resolve() == path] == held
    assert len(held) == 1


def test_threads_at_once_read_while_one_writes(tmp_path: Path) -> None:
    catalogue = Catalogue(tmp_path / "c.sqlite")
    with ThreadPoolExecutor(8) as pool:
        written = pool.map(lambda i: catalogue.add_runs([summary(i)]), range(60))
        read = pool.map(lambda _: len(catalogue.runs()), range(60))
        assert all(0 <= count <= 60 for count in read)
        assert list(written) == [None] * 60
    assert catalogue.count() == 60
    catalogue.close()
