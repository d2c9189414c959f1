"""Campaign folders with broadband excitation."""

from pathlib import Path

import numpy as np
import pytest

from daq.errors import InputError
from daq.importers.broadband import is_broadband, read_broadband

CARD = """
format = "campaign-folder/1"
title = "one long recording"
sample_rate_hz = 600.0
[excitation]
kind = "broadband"
file = "recording.csv"
estimation = [1000, 4000]
test = [0, 900]
period_samples = 512
period_starts = [1100, 1700]
[declared_model]
feedback = "cubic"
[[channels]]
name = "response"
variable = "y"
quantity = "pressure"
unit = "Pa"
volts_per_unit = 0.5
[[channels]]
name = "drive"
variable = "u"
quantity = "voltage"
unit = "V"
"""


def folder(path: Path, card: str = CARD, frames: int = 4000) -> Path:
    values = np.random.default_rng(1).standard_normal((frames, 2))
    np.savetxt(path / "recording.csv", values, delimiter=",", header="y,u", comments="")
    (path / "campaign.toml").write_text(card)
    return path


def test_what_stands_in_the_folder_is_read(tmp_path: Path) -> None:
    record = read_broadband(folder(tmp_path))
    values = np.loadtxt(tmp_path / "recording.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(record.response, values[:, 0] / 0.5)
    np.testing.assert_allclose(record.drive, values[:, 1])
    assert (record.estimation, record.test, record.noise) == (
        slice(1000, 4000), slice(0, 900), None
    )  # fmt: skip
    assert record.feedback == "cubic"
    assert is_broadband(tmp_path)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("estimation = [1000, 4000]", "estimation = [1000, 4001]", r"estimation=\[1000, 4001\]"),
        ("estimation = [1000, 4000]", "estimation = [1000]", "estimation"),
        ('feedback = "cubic"', 'feedback = "quartic"', "feedback='quartic'"),
        ('name = "drive"', 'name = "force"', "named 'drive'"),
        ("period_samples = 512\n", "", "period_samples"),
        ('file = "recording.csv"', 'file = "../recording.csv"', "outside"),
        ("title", "mains = 50\ntitle", "mains"),
        ("volts_per_unit = 0.5", "volts_per_unit = 0.0", "'response': volts_per_unit=0.0"),
        ('unit = "Pa"', 'unit = "kPa"', "unit='kPa' is not SI; give unit 'Pa'"),
        ("period_starts = [1100, 1700]\n", "", "period_samples=512 needs period_starts"),
        ("[1100, 1700]", "[900, 1700]", r"period \[900, 1412\] is not within estimation"),
        ("[1100, 1700]", "[1100, 3500]", r"period \[3500, 4012\] is not within estimation"),
        ('variable = "y"', 'variable = "z"', "no column 'z'; there are y, u"),
    ],
)
def test_a_folder_that_cannot_be_used_says_why(
    tmp_path: Path, old: str, new: str, says: str
) -> None:
    assert old in CARD
    with pytest.raises(InputError, match=says):
        read_broadband(folder(tmp_path, CARD.replace(old, new)))


def test_the_recording_is_the_one_declared(tmp_path: Path) -> None:
    """Sampled at the rate declared, and without columns that nobody declared."""
    values = np.random.default_rng(1).standard_normal((4000, 3))
    table = np.column_stack([np.arange(4000) / 500.0, values[:, :2]])
    folder(tmp_path)
    np.savetxt(tmp_path / "recording.csv", table, delimiter=",", header="time,y,u", comments="")
    with pytest.raises(InputError, match=r"sampled at 500 Hz, but sample_rate_hz=600"):
        read_broadband(tmp_path)
    np.savetxt(tmp_path / "recording.csv", values, delimiter=",")
    with pytest.raises(InputError, match="3 columns for 2 declared channels"):
        read_broadband(tmp_path)


def test_an_ordinary_folder_is_none(tmp_path: Path) -> None:
    (tmp_path / "campaign.toml").write_text('format = "campaign-folder/1"')
    assert not is_broadband(tmp_path)
    assert not is_broadband("20261121-some-id")
