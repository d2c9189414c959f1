"""The report of a broadband record: complete, self-contained, and saying what the result says."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from daq.cli import app
from daq.errors import InputError
from identify.broadband import BroadbandDiagnosis, Lines, diagnose_broadband
from identify.report.broadband import broadband_html, evidence, headline
from tests.broadband_material import RATE, duffing_output, multisine
from tests.test_report_html import Reader

PERIOD = 2048
CARD = """
format = "campaign-folder/1"
title = "a cubic spring"
sample_rate_hz = 600.0
[declared_model]
feedback = "linear"
[[channels]]
name = "drive"
quantity = "voltage"
unit = "V"
[[channels]]
name = "response"
quantity = "pressure"
unit = "Pa"
[excitation]
kind = "broadband"
file = "recording.csv"
estimation = [300, 4096]
test = [4096, 6144]
"""


def _diagnosed(*, repeated: bool, second_mode: float) -> BroadbandDiagnosis:
    """A cubic spring, or a second mode, against a declared linear oscillator; Pa over V."""
    seeds = [1, 1, 1] if repeated else [1, 2, 3]
    u = np.concatenate([multisine(PERIOD, seed) for seed in seeds])
    y = duffing_output(u, cubic=0.0 if second_mode else 4.0)
    if second_mode:
        y = y + second_mode * duffing_output(u, cubic=0.0, hz=150.0)
    y = y + 3e-4 * np.random.default_rng(8).standard_normal(y.size)
    return diagnose_broadband(
        u,
        y,
        RATE,
        declared="linear",
        estimation=slice(300, 2 * PERIOD),
        test=slice(2 * PERIOD, 3 * PERIOD),
        lines=Lines((PERIOD, 2 * PERIOD), PERIOD) if repeated else None,
        title="<a record>",
        units=("V", "Pa"),
    )


@pytest.mark.parametrize("repeated", [True, False], ids=["repeated periods", "noise unknown"])
def test_what_was_found_is_said_and_shown(repeated: bool) -> None:
    found = _diagnosed(repeated=repeated, second_mode=0.0)
    reader = Reader()
    reader.feed(broadband_html(found))
    assert reader.open == []
    assert headline(found) == "Traced: nonlinearity_shape (cubic; nonlinearity)"
    for line in (headline(found), *evidence(found)):
        assert line in reader.text
    assert "Restoring force" in reader.headings
    assert "<a record>" in reader.text
    assert "Next experiment" not in reader.headings
    assert "nonlinearity.c3" in reader.text
    assert "1/Pa^2" in reader.text or "1/Pa²" in reader.text
    assert set(reader.references) <= set(reader.ids)
    assert {"broadband-errors", "broadband-spectrum", "broadband-motion"} <= set(reader.ids)


def test_what_was_not_claimed_is_not_shown_as_found() -> None:
    found = _diagnosed(repeated=False, second_mode=0.4)
    reader = Reader()
    reader.feed(broadband_html(found))
    assert reader.open == []
    assert headline(found).startswith("Unexplained")
    assert "The noise is unknown" in reader.text
    assert "Tried and not claimed" in reader.text
    assert "Next experiment" in reader.headings
    assert "Restoring force" not in reader.headings


def test_the_command_names_what_it_cannot_use(tmp_path: Path) -> None:
    u = multisine(3 * PERIOD, 1)
    values = np.c_[u, duffing_output(u)]
    np.savetxt(tmp_path / "recording.csv", values, delimiter=",", header="u,y", comments="")
    (tmp_path / "campaign.toml").write_text(CARD.replace("[4096, 6144]", "[4000, 6144]"))
    with pytest.raises(InputError, match=r"test=\[4000, 6144\] overlap"):
        CliRunner().invoke(app, ["diagnose", str(tmp_path)], catch_exceptions=False)


def test_the_command_prints_writes_and_draws(tmp_path: Path) -> None:
    """`entrain diagnose` of a folder: table, JSON and report say the same."""
    u = np.concatenate([multisine(PERIOD, seed) for seed in (1, 2, 3)])
    y = duffing_output(u) + 3e-4 * np.random.default_rng(8).standard_normal(u.size)
    np.savetxt(tmp_path / "recording.csv", np.c_[u, y], delimiter=",", header="u,y", comments="")
    (tmp_path / "campaign.toml").write_text(CARD)
    report, answer = tmp_path / "report.html", tmp_path / "answer.json"
    command = ["diagnose", str(tmp_path), "--html", str(report), "--json", str(answer)]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    found = json.loads(answer.read_text("utf-8"))
    assert [e["effect"] for e in found["effects"]] == ["nonlinearity_shape"]
    assert found["verdict"] == "traced"
    assert "Traced: nonlinearity_shape (cubic; nonlinearity)" in done.output
    assert "Traced: nonlinearity_shape (cubic; nonlinearity)" in report.read_text("utf-8")
