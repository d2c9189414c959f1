"""The command line on a simulated rig: dry run, campaign, resume, check, devices."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from scipy.io import wavfile

from daq.errors import CorruptFile
from daq.journal import read_journal
from daq.store import read_card
from daq.store_file import open_run, read_summary
from tests.test_cli_data import entrain, home  # noqa: F401  (a fixture)

PLAN = """title = "quick"
record_s = 0.5
conditions = [{ offset = -0.02, over_threshold = 1.5 }, { offset = 0.02, amplitude_v = 1.0 }]
"""


@pytest.fixture
def plan(home: Path) -> Path:  # noqa: F811
    path = home / "plan.toml"
    path.write_text(PLAN, encoding="utf-8")
    return path


def test_dry_run_moves_nothing_and_counts(plan: Path, capfd: pytest.CaptureFixture[str]) -> None:
    words = ("campaign", "dry-run", plan, "--free-hz", "170", "--json", "-")
    code, out, err = entrain(capfd, *words)
    assert (code, err) == (0, "")
    report = json.loads(out)
    assert report["runs"] == 3
    # 166.6 Hz to the nearest multiple of 2 Hz, the spacing of a 0.5 s record's bins.
    assert report["conditions"][1]["frequency_hz"] == 166.0
    plan.write_text(PLAN.replace("1.0 }", "99.0 }"), encoding="utf-8")
    code, _, err = entrain(capfd, "campaign", "dry-run", plan)
    assert code == 2
    assert "99" in err


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ('limits = [{ channel = "nope", high = 1.0 }]', "limits name the channel 'nope'; the rig"),
        ('control_channel = "drive"', "control_channel='drive' is no pressure channel"),
        ("online = { wanted = { bogus = 0.1 } }", "online.wanted: 'bogus' is not a parameter"),
    ],
)
@pytest.mark.parametrize("command", ["dry-run", "run"])
def test_a_plan_that_cannot_work_on_the_rig_is_refused_before_it_moves(
    plan: Path, capfd: pytest.CaptureFixture[str], command: str, line: str, says: str
) -> None:
    plan.write_text(f"{line}\n{PLAN}", encoding="utf-8")
    code, _, err = entrain(capfd, "campaign", command, plan)
    assert (code, says in err) == (2, True), err
    assert "no campaigns" in entrain(capfd, "campaign", "list")[1]


def test_campaign_run_list_and_show(plan: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, out, err = entrain(capfd, "campaign", "run", plan, "--seed", "3", "--json", "-")
    assert (code, err) == (0, "")
    result = json.loads(out)
    assert result["status"] == "complete"
    assert [o["status"] for o in result["outcomes"]] == ["success", "entrained", "entrained"]
    # physics.md: 169.713 Hz; a free record of a second resolves a tenth of that spacing.
    assert result["free"]["frequency_hz"] == pytest.approx(169.713, abs=0.1)
    assert "complete" in entrain(capfd, "campaign", "list")[1]
    code, out, _ = entrain(capfd, "campaign", "resume", result["campaign"], "--rig", "simulated")
    assert code == 0
    assert "complete" in out
    assert entrain(capfd, "store", "verify")[0] == 0
    code, out, _ = entrain(capfd, "store", "export", result["campaign"], plan.parent / "out.zip")
    assert code == 0
    assert (plan.parent / "out.zip").exists()
    code, _, err = entrain(
        capfd, "store", "export", result["campaign"], plan.parent / "no" / "o.zip"
    )
    assert code == 2
    assert "give a file in a folder that exists" in " ".join(err.replace("│", " ").split())


def test_design_writes_a_plan_that_a_campaign_takes(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    clean = Path(__file__).parent / "data" / "a-clean"
    words = ("campaign", "design", clean, "--out", "best.json", "--runs", "3")
    code, out, err = entrain(capfd, *words)
    assert (code, err) == (0, "")
    assert "3 conditions" in out
    plan = json.loads((home / "best.json").read_text("utf-8"))
    # recorded elsewhere: its cold runs, if any, are unknown to this store, and so is its rig
    assert "continues" not in plan
    assert (len(plan["conditions"]), plan["cold"]) == (3, [])
    code, out, _ = entrain(capfd, "campaign", "dry-run", "best.json", "--json", "-")
    assert code == 0
    assert [row["kind"] for row in json.loads(out)["conditions"]] == ["free"] + 3 * ["forced"]


def test_a_design_keeps_away_from_a_run_that_was_excluded(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    """The run at 168 Hz is clipped for the most part; 168.5 Hz had been proposed then."""
    folder = copytree(Path(__file__).parent / "data" / "a-clean", home / "spoilt")
    spoilt = folder / "runs" / "03_168Hz.wav"
    rate, samples = wavfile.read(spoilt)
    most = np.array([np.ptp(samples[:, 0]) // 8, 2**15 - 1, 2**15 - 1])
    wavfile.write(spoilt, rate, np.clip(samples, -most, most).astype(samples.dtype))
    words = ("campaign", "design", folder, "--out", "best.json", "--runs", "4")
    code, out, err = entrain(capfd, *words)
    assert (code, err) == (0, "")
    plan = json.loads((home / "best.json").read_text("utf-8"))
    places = [row["frequency_hz"] for row in plan["conditions"]]
    assert len(places) == 4
    assert all(abs(f / 168.0 - 1) >= 0.004 for f in places), places
    assert "add the new ones to its folder" in " ".join(out.split())


def test_check_finds_the_simulated_rig_fit(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    code, out, _ = entrain(capfd, "check")
    assert code == 0
    assert "silence" in out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("campaign", "run", "--rig", "none"), "none"),
        (("campaign", "run", "absent.toml"), "absent.toml"),
        (("campaign", "resume", "nothing"), "nothing"),
        (("identify", "/nowhere"), "/nowhere"),
        (("diagnose", "nothing"), "nothing"),
        (("characterise", "absent.txt"), "absent.txt"),
        (("campaign", "show", ""), "campaign='' is no campaign"),
        (("campaign", "list", "--verdict", "bogus"), "--verdict='bogus' is not one of no_discrep"),
        (("characterise", "/tmp"), "/tmp: is a folder: give a file"),
        (("characterise", "/dev/null"), "/dev/null: is a pipe or a device: give a file"),
        (("campaign", "dry-run", "/tmp"), "/tmp: is a folder: give a file"),
        (("characterise", "absent.txt", "--rate-hz", "nan"), "'--rate-hz': nan is not a finite"),
        (("characterise", "absent.txt", "--figure", "x.exe"), "'x.exe' does not end in .png"),
        (("characterise", "absent.txt", "--figure", "/nope/x.png"), "/nope does not exist"),
        (("campaign", "design", "nothing", "--out", "/nope/x.toml"), "/nope does not exist"),
        (("reproduce", "--out", "/etc/hostname"), "'/etc/hostname' is a file"),
        (("demo", "--out", "/etc/hostname/x"), "'/etc/hostname' is a file"),
        (
            ("campaign", "dry-run", "--free-hz", "inf"),
            "'--free-hz': inf is not a finite number > 0",
        ),
        (
            ("campaign", "dry-run", "--free-hz", "-5"),
            "'--free-hz': -5.0 is not a finite number > 0",
        ),
        (("campaign", "design", "x", "--out", "y.toml", "--minutes", "nan"), "--minutes"),
        (("close-loop", "--minutes", "nan"), "--minutes"),
        (("check", "--frequency-hz", "nan"), "--frequency-hz"),
        (("hil", "--seconds", "nan"), "'--seconds': nan is not a finite number > 0"),
        (("hil", "--seconds", "-1"), "'--seconds': -1.0 is not a finite number > 0"),
        (("hil", "--gain", "nan"), "--gain"),
        (("keys", "create", "x", "--expires", "99999999999y"), "--expires='99999999999y' is more"),
    ],
)
def test_what_is_not_possible_says_so(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
    words: tuple[str, ...],
    says: str,
) -> None:
    code, out, err = entrain(capfd, *words)
    assert (code, out) == (2, "")
    assert says in err
    assert "Traceback" not in err


def test_characterise_a_plain_sine(home: Path, capfd: pytest.CaptureFixture[str]) -> None:  # noqa: F811
    time = np.arange(20_000) / 2000.0
    noise = 0.01 * np.random.default_rng(1).standard_normal(time.size)
    np.savetxt(home / "sine.txt", np.column_stack([time, np.sin(2 * np.pi * 100 * time) + noise]))
    code, out, err = entrain(capfd, "characterise", home / "sine.txt", "--json", "-")
    assert (code, err) == (0, "")
    found = json.loads(out)
    assert found["format"] == "characterisation/1"
    # Amplitude 1 at 100 Hz; noise of 0.01 over 20 000 samples leaves 1e-4 of uncertainty.
    assert found["frequency_hz"]["value"] == pytest.approx(100.0, abs=1e-2)
    assert found["amplitude"]["value"] == pytest.approx(1.0, abs=1e-2)
    wavfile.write(home / "sine.wav", 2000, np.sin(2 * np.pi * 100 * time).astype(np.float32))
    code, _, err = entrain(capfd, "characterise", home / "sine.wav", "--rate-hz", "5000")
    assert (code, "rate_hz=5000 is not the file's own, 2000" in err) == (2, True), err


CAMPAIGN = 'title = "cut off"\nrecord_s = 1.5\nconditions = [{ offset = 0.02 }]\n'
RIGS = """[rigs.real]
driver = "simulated"
options = { clock = "realtime" }
"""


@contextmanager
def recording(home: Path, terminal: int | None = None) -> Iterator[subprocess.Popen[bytes]]:  # noqa: F811
    """A campaign in a process of its own, which has begun to write its first run."""
    (home / "entrain.toml").write_text(RIGS, encoding="utf-8")
    (home / "plan.toml").write_text(CAMPAIGN, encoding="utf-8")
    words = [sys.executable, "-m", "daq.cli", "campaign", "run", "plan.toml", "--rig", "real"]
    child = subprocess.Popen(
        words,
        stdin=terminal,
        stdout=terminal if terminal is not None else subprocess.DEVNULL,
        stderr=terminal if terminal is not None else subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)},
        start_new_session=True,
    )
    try:
        end = time.monotonic() + 60
        while written_frames(home) < 2000:
            assert child.poll() is None, "the campaign ended before it recorded"
            assert time.monotonic() < end
            time.sleep(0.02)
        yield child
    finally:
        child.kill()
        child.wait()


def written_frames(home: Path) -> int:  # noqa: F811
    for path in home.glob("data/**/.*.h5.partial"):
        with contextlib.suppress(CorruptFile), open_run(path, live=True) as file:
            return int(file["entry/quality/n_valid"][()])
    return 0


@pytest.mark.skipif(sys.platform == "win32", reason="kill -9 is POSIX's")
def test_going_on_after_a_kill_keeps_what_was_recorded(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    with recording(home) as child:
        child.kill()
        child.wait()
    (folder,) = home.glob("data/**/campaigns/*")
    (home / "entrain.toml").write_text(RIGS.replace("realtime", "virtual"), encoding="utf-8")
    code, _, err = entrain(capfd, "campaign", "resume", folder.name)
    assert code == 0, err
    runs = [read_summary(path, folder.name) for path in (folder / "runs").iterdir()]
    broken_off, anew, _ = sorted(runs, key=lambda run: len(run.name))
    assert (broken_off.name, broken_off.exit_status) == ("000-free", "interrupted")
    assert broken_off.samples >= 2000
    assert (anew.name, anew.exit_status) == ("000-free-2", "success")
    assert entrain(capfd, "store", "verify")[0] == 0


@pytest.mark.skipif(sys.platform == "win32", reason="the signals are POSIX's")
@pytest.mark.parametrize("strike", [signal.SIGTERM, "hang up"])
def test_whatever_ends_a_campaign_is_recorded_as_its_end(
    home: Path,  # noqa: F811
    strike: int | str,
) -> None:
    keyboard, terminal = os.openpty()
    with recording(home, terminal) as child:
        os.close(terminal)
        if strike == "hang up":
            os.close(keyboard)
            os.kill(child.pid, signal.SIGHUP)
        else:
            os.kill(child.pid, signal.SIGTERM)
        assert child.wait(30) == 1  # as after Ctrl-C: not complete
    if strike != "hang up":
        os.close(keyboard)
    (folder,) = home.glob("data/**/campaigns/*")
    last = read_journal(folder / "journal.jsonl")[-1]
    assert (last["kind"], last["data"]["status"]) == ("finished", "stopped")
    assert "ended by SIG" in last["data"]["reason"]
    assert read_card(folder / "campaign.json").status == "stopped"
    assert list((folder / "runs").glob(".*.partial")) == []
