"""What the commands that analyse do before and after their long work."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from identify.characterise import Recording, primary
from identify.effects import CANDIDATES
from tests.test_cli_data import entrain, home

__all__ = ["home"]


@pytest.mark.parametrize("command", ["diagnose", "identify"])
@pytest.mark.parametrize("option", ["--json", "--html"])
def test_a_place_that_cannot_be_written_is_refused_before_the_work(
    home: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    command: str,
    option: str,
) -> None:
    """The search had been done, and its result lost."""
    case = Path(__file__).parent / "data" / "b-flame-delay"

    def searched(*args: object, **kwargs: object) -> None:
        raise AssertionError("searched first")

    monkeypatch.setattr("identify.diagnosis.diagnose", searched)
    monkeypatch.setattr("identify.identification.identify", searched)
    for place, says in (("nowhere/found.out", "nowhere does not exist"), (".", "is a folder")):
        code, out, err = entrain(capfd, command, case, option, place)
        assert (code, out) == (2, "")
        assert says in " ".join(err.replace("│", " ").split())


@pytest.mark.parametrize("minutes", ["0", "-1", "nan"])
def test_a_limit_of_time_that_is_none_is_refused(
    home: Path, capfd: pytest.CaptureFixture[str], minutes: str
) -> None:
    case = Path(__file__).parent / "data" / "b-flame-delay"
    code, out, err = entrain(capfd, "diagnose", case, "--within", minutes)
    assert (code, out) == (2, "")
    assert "minutes above zero" in err


def test_a_broadband_search_takes_no_limit_of_time(
    home: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """It had been taken, and not kept to."""
    folder = home / "shaken"
    folder.mkdir()
    (folder / "campaign.toml").write_text("[excitation]\n", "utf-8")
    code, out, err = entrain(capfd, "diagnose", folder, "--within", "5")
    assert (code, out) == (2, "")
    assert "within=5: a broadband search has no limit" in " ".join(err.split())


def test_the_signal_that_is_characterised_is_the_one_drawn(
    home: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`photodiode` begins with p, and had been drawn for the pressure."""
    t = np.arange(20000) / 5000.0
    rng = np.random.default_rng(1)
    rows = [np.sin(2 * np.pi * 170 * t + a) + 0.01 * rng.standard_normal(t.size) for a in (0, 1)]
    recording = Recording({"photodiode": rows[0], "mic": rows[1]}, 5000.0, None, "V")
    assert primary(recording) == "mic"
    rests = Recording({"channel1": rows[0], "p2": rows[1], "drive": 0 * rows[0]}, 5000.0, None, "V")
    assert primary(rests) == "p2"
    unnamed = {"channel1": rows[0], "channel2": 0 * rows[0]}
    assert primary(Recording(unnamed, 5000.0, None, "V")) == "channel1"
    assert primary(recording, "photodiode") == "photodiode"
    with pytest.raises(ValueError, match="signal='p1' is not one of"):
        primary(recording, "p1")
    file = home / "two.csv"
    np.savetxt(file, np.c_[t, rows[0], rows[1]], delimiter=",")
    drawn: list[np.ndarray] = []

    def draw(found: object, values: np.ndarray, place: Path, title: str) -> None:
        drawn.append(values)
        assert title == "two.csv, mic"

    monkeypatch.setattr("identify.characterise.figure", draw)
    words = ("characterise", file, "--name", "photodiode", "--name", "mic", "--figure", "a.svg")
    code, out, _ = entrain(capfd, *words, "--json", "found.json")
    assert code == 0
    np.testing.assert_allclose(drawn[0], rows[1])
    for note in json.loads((home / "found.json").read_text("utf-8"))["notes"]:
        assert note[:40] in out
    assert re.search(r"signal +│ mic ", out)


def test_what_a_diagnosis_can_find_is_listed(home: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Every candidate, with the range that its parameters may be in."""
    code, out, _ = entrain(capfd, "effects", "--json", "-")
    listed = [(e["effect"], e["form"]) for e in json.loads(out)["effects"]]
    assert (code, listed) == (0, [(e.name, e.form) for e in CANDIDATES])
    code, out, _ = entrain(capfd, "effects", "flame_delay")
    assert code == 0
    assert "delay_s: 1e-06 to 0.02 s" in out
    code, out, _ = entrain(capfd, "effects", "flame_delay", "--json", "-")
    (delay,) = json.loads(out)["effects"]
    assert (code, delay["location"]) == (0, "flame")
    assert delay["parameters"] == [{"name": "delay_s", "unit": "s", "range": [1e-6, 0.02]}]
    code, out, err = entrain(capfd, "effects", "flame_delays")
    assert (code, out) == (2, "")
    assert "name='flame_delays' is no effect: one of acoustic_mode" in " ".join(err.split())
