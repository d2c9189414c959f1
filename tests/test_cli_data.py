"""The command line on recorded data, keys and configuration, as a user calls it."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from daq.service.commands.analysis import show_quality
from daq.store import RunStore
from identify.results import Diagnosis, QualityFlag
from tests.service_data import make_folder
from tests.small_disk import fill, small_disk


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


def entrain(capfd: pytest.CaptureFixture[str], *words: object) -> tuple[int, str, str]:
    from daq.cli import main

    with pytest.raises(SystemExit) as ended:
        main([str(word) for word in words])
    captured = capfd.readouterr()
    return int(ended.value.code or 0), captured.out, captured.err


def test_import_list_show_rebuild(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    code, out, _ = entrain(capfd, "import", make_folder(home / "sines"))
    assert code == 0
    campaign = out.split()[1].rstrip(":")
    assert "3 runs" in out
    assert campaign in entrain(capfd, "campaign", "list")[1]
    code, out, _ = entrain(capfd, "campaign", "show", campaign)
    assert "validation" in out
    assert entrain(capfd, "store", "rebuild")[0] == 0


def test_what_a_terminal_cannot_show_is_replaced() -> None:
    for words in (["effects", "flame_delay"], ["effects", "flame_delay", "--json", "-"]):
        done = subprocess.run(
            [sys.executable, "-m", "daq.cli", *words],
            env={**os.environ, "PYTHONIOENCODING": "ascii"},
            capture_output=True,
        )
        assert (done.returncode, done.stderr) == (0, b"")
        assert b"flame_delay" in done.stdout
    assert json.loads(done.stdout)["effects"]


def test_a_key_that_interrupts_is_told(
    home: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("daq.importers.open_campaign", interrupted)
    assert entrain(capfd, "campaign", "show", "x") == (130, "", "entrain: interrupted\n")


def test_import_of_a_single_recording(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    folder = make_folder(home / "sines")
    channels = ("p1:pressure:Pa:0.01:0.7", "p2:pressure:Pa:0.01:0.8", "drive:voltage:V:1")
    words = [word for text in channels for word in ("--channel", text)]
    code, out, err = entrain(capfd, "import", folder / "free.wav", *words)
    assert (code, err) == (0, "")
    assert "1 runs" in out


def test_every_folder_given_is_imported(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Of two, the second had been passed over in silence."""
    one, other = make_folder(home / "one"), make_folder(home / "other")
    code, out, _ = entrain(capfd, "import", one, other)
    assert (code, out.count("3 runs")) == (0, 2)
    listed = entrain(capfd, "campaign", "list")[1]
    assert "one-" in listed
    assert "other-" in listed


def test_what_does_not_apply_to_folders_is_refused(
    home: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = make_folder(home / "sines")
    for words, says in (
        (("--title", "x", "--rate-hz", "5"), "--title, --rate-hz: only for single recordings"),
        (("--kind", "free"), "--kind: only for single recordings"),
        ((folder / "free.wav",), "import folders and recordings separately"),
        ((home / "absent",), "absent: no such file or folder"),
    ):
        code, out, err = entrain(capfd, "import", folder, *words)
        assert (code, out) == (2, "")
        assert says in err
    assert "no campaigns" in entrain(capfd, "campaign", "list")[1]


@pytest.mark.parametrize("title", ["Rig A [flame off], day 2", "odd [/x] title"])
def test_titles_are_shown_as_they_are(
    home: Path, capfd: pytest.CaptureFixture[str], title: str
) -> None:
    """They had been read as Rich's markup."""
    recording = make_folder(home / "sines") / "free.wav"
    channels = ("p1:pressure:Pa:0.01:0.7", "p2:pressure:Pa:0.01:0.8", "drive:voltage:V:1")
    words = [word for text in channels for word in ("--channel", text)]
    _, out, _ = entrain(capfd, "import", recording, "--title", title, *words)
    code, out, _ = entrain(capfd, "campaign", "show", out.split()[1].rstrip(":"))
    assert code == 0
    assert title in out


def test_files_left_out_are_shown_as_they_are(
    home: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    damaged = home / "store [old]" / "campaigns" / "c" / "campaign.json"
    damaged.parent.mkdir(parents=True)
    damaged.write_text("{")
    code, out, _ = entrain(capfd, "store", "rebuild", "--store", home / "store [old]")
    assert code == 1
    assert "store [old]" in " ".join(out.split())


@pytest.mark.parametrize(
    ("text", "says"),
    [("", "no line of numbers, the file is empty"), ("1,2\n3\n", "line 2 has 1 columns where 2")],
)
def test_a_table_that_is_none_cannot_be_characterised(
    home: Path, capfd: pytest.CaptureFixture[str], text: str, says: str
) -> None:
    (home / "x.csv").write_text(text)
    code, out, err = entrain(capfd, "characterise", home / "x.csv", "--rate-hz", "100")
    assert (code, out) == (2, "")
    assert says in err
    assert "loadtxt" not in err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("import", "/nowhere"), "/nowhere"),
        (("campaign", "show", "nothing"), "nothing"),
        (("keys", "create", "a", "--scope", "root"), "root"),
        (("keys", "create", "a", "--expires", "soon"), "soon"),
        (("keys", "revoke", "00000000"), "00000000"),
        (("--config", "absent.toml", "config", "show"), "absent.toml"),
        (("serve", "--host", "0.0.0.0"), "entrain keys create"),
        (("serve", "--port", "99999999"), "port"),
        (("nonsense",), "nonsense"),
    ],
)
def test_what_is_not_possible_ends_with_one_line_and_2(
    home: Path, capfd: pytest.CaptureFixture[str], words: tuple[str, ...], says: str
) -> None:
    code, out, err = entrain(capfd, *words)
    assert (code, out) == (2, "")
    assert says in err
    assert "Traceback" not in err


def test_keys_are_shown_once_and_can_be_revoked(
    home: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    code, text, _ = entrain(capfd, "keys", "create", "desk", "--scope", "control")
    assert code == 0
    identifier = text.split("_")[1]
    code, out, _ = entrain(capfd, "keys", "list")
    assert "active" in out
    assert text.strip() not in out
    assert entrain(capfd, "keys", "revoke", identifier)[0] == 0
    assert "revoked" in entrain(capfd, "keys", "list")[1]


def test_on_a_full_disk_the_file_and_the_remedy_are_named(
    home: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with small_disk(home / "disk") as place:
        monkeypatch.setenv("ENTRAIN_DATA_DIR", str(place))
        store = RunStore(place / "store")
        torn = store.campaign_dir(store.create_campaign("torn").id) / "runs" / "000-free.h5"
        torn.write_bytes(b"nothing of use")
        fill(place)
        before = set(place.iterdir())
        store.close()
        for words, file in (
            (("keys", "create", "ann"), "keys.json"),
            (("effects", "--json", place / "effects.json"), "effects.json"),
            (("store", "recover"), "000-free.h5"),
        ):
            code, _, err = entrain(capfd, *words)
            assert code == 1
            assert err.count("\n") == 1
            assert file in err
            assert "make room" in err
        assert {path.name for path in set(place.iterdir()) - before} <= {"quarantine"}
        assert torn.exists()


def test_config_show_says_where_from(
    home: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ENTRAIN_SERVER__PORT", "9123")
    code, out, _ = entrain(capfd, "config", "show", "--json")
    assert code == 0
    assert json.loads(out)["server.port"] == {
        "value": 9123,
        "source": "environment ENTRAIN_SERVER__PORT",
    }


def test_what_is_alike_in_several_runs_is_said_once(capfd: pytest.CaptureFixture[str]) -> None:
    """Six lines of hum in eleven runs had been sixty rows."""
    found = SimpleNamespace(
        quality=[
            QualityFlag(run, "mains_hum", f"line at {hz} Hz, {size} Pa; {n} × 50 Hz: look")
            for run, hz, size in (("r1", 50.01, 15.1), ("r2", 49.98, 14.0), ("r3", 50.0, 2.25))
            for n in (1, 3)
        ]
    )
    show_quality(cast(Diagnosis, found))
    said = capfd.readouterr().out
    assert said.count("and 2 more") == 2
    assert said.count("line at 50.01 Hz") == 2
    assert "49.98" not in said


def test_help_is_quick_and_loads_no_heavy_library() -> None:
    heavy = ("numpy", "fastapi", "numba", "scipy")
    code = f"import sys, daq.cli; print([m for m in {heavy} if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_page_of_commands_is_theirs(monkeypatch: pytest.MonkeyPatch) -> None:
    """No command, option or setting without a line; README names every group."""
    from daq.service.commands.document import page

    root = Path(__file__).resolve().parents[1]
    monkeypatch.setenv("COLUMNS", "40")  # however wide the terminal is
    text = page()
    assert (root / "docs" / "commands.md").read_text("utf-8") == text, (
        "run: python -m daq.service.commands.document > docs/commands.md"
    )
    readme = (root / "README.md").read_text("utf-8")
    first = {line.split()[2] for line in text.splitlines() if line.startswith("## entrain ")}
    assert [name for name in sorted(first) if f"entrain {name}" not in readme] == []
