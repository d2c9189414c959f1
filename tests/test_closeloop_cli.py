"""`entrain close-loop` in a terminal: what it takes, what it keeps of the rig, when it tells."""

import json
from pathlib import Path
from typing import Any

import pytest

from daq.importers import import_folder
from daq.service import rigs
from daq.service.settings import load
from daq.store import RunStore
from tests.test_cli_data import entrain, home  # noqa: F401  (a fixture)

PLAN = """title = "quick"
record_s = 0.5
conditions = [{ offset = -0.02, over_threshold = 1.5 }, { offset = 0.02, amplitude_v = 1.0 }]
"""
# every sample is above it: the campaign ends in its first window, as one that is stopped does
AT_ONCE = 'limits = [{ channel = "p1", high = 1e-6, action = "end" }]\n'
DESIGN = 'record_s = 0.5\n[design]\ncampaign = "{campaign}"\nruns = 2\n'


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """The options of every rig that is opened."""
    seen: list[dict[str, Any]] = []
    honest = rigs.open_rig

    def open_rig(entry: rigs.RigEntry) -> Any:
        seen.append(entry.options)
        return honest(entry)

    monkeypatch.setattr(rigs, "open_rig", open_rig)
    return seen


def written(folder: Path, text: str) -> Path:
    path = folder / "plan.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_a_plan_with_a_design_is_looped_as_it_is_run(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    store = RunStore(load(None).store_dir)
    known = import_folder(Path(__file__).parent / "data" / "a-clean", store).id
    store.close()
    plan = written(home, DESIGN.format(campaign=known))
    # a free run is 3.5 s, each of the two conditions 6.5 s: without these the loop would begin
    code, out, err = entrain(capfd, "close-loop", plan, "--minutes", "0.25", "--json", "-")
    assert (code, err) == (1, "")
    closed = json.loads(out)
    assert (closed["ending"], closed["rounds"]) == ("out_of_budget", [])
    assert "needs about 0.3 min" in closed["reason"]


def test_a_sealed_loop_goes_on_with_the_plant_that_it_began_with(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
    opened: list[dict[str, Any]],
) -> None:
    plan = written(home, PLAN + AT_ONCE)
    words = ("close-loop", plan, "--sealed", "--seed", "5", "--json", "-")
    code, out, err = entrain(capfd, *words)
    assert (code, err) == (1, "")
    name = json.loads(out)["name"]
    assert json.loads(out)["ending"] == "stopped"
    store = RunStore(load(None).store_dir)
    assert store.card(name).notes["rig_options"] == {"seed": 5, "effects": "sealed"}
    store.close()

    code, out, err = entrain(capfd, "close-loop", "--resume", name)
    assert (code, err) == (1, "")
    assert f"entrain close-loop --resume {name}" in out
    assert opened == [{"seed": 5, "effects": "sealed"}] * 2
    # the same said again is no contradiction
    assert entrain(capfd, "close-loop", "--resume", name, "--seed", "5", "--sealed")[0] == 1
    code, out, err = entrain(capfd, "close-loop", "--resume", name, "--seed", "6")
    assert (code, out) == (2, "")
    assert f"seed=6: '{name}' began with 5" in err
    assert len(opened) == 3


def test_a_seeded_campaign_goes_on_with_the_plant_that_it_began_with(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
    opened: list[dict[str, Any]],
) -> None:
    plan = written(home, PLAN + AT_ONCE)
    code, out, err = entrain(capfd, "campaign", "run", plan, "--seed", "5", "--json", "-")
    assert (code, err) == (1, "")
    name = json.loads(out)["campaign"]
    assert entrain(capfd, "campaign", "resume", name)[0] == 1
    assert entrain(capfd, "campaign", "resume", name, "--seed", "5")[0] == 1
    assert opened == [{"seed": 5}] * 3
    code, out, err = entrain(capfd, "campaign", "resume", name, "--seed", "6")
    assert (code, out) == (2, "")
    assert f"seed=6: '{name}' began with 5" in err


def test_a_loop_that_began_unsealed_is_not_sealed_later(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    config = written(home, '[rigs.one]\ndriver = "simulated"\n[rigs.two]\ndriver = "simulated"\n')
    config = config.rename(home / "config.toml")
    plan = written(home, PLAN + AT_ONCE)
    here = ("--config", config, "close-loop")
    name = json.loads(entrain(capfd, *here, plan, "--rig", "one", "--json", "-")[1])["name"]
    code, _, err = entrain(capfd, *here, "--resume", name, "--sealed")
    assert code == 2
    assert "effects='sealed'" in err
    code, _, err = entrain(capfd, *here, "--resume", name, "--rig", "two")
    assert code == 2
    assert "began on rig 'one'" in err


def test_what_is_sealed_is_told_only_beside_a_verdict(
    home: Path,  # noqa: F811
    capfd: pytest.CaptureFixture[str],
) -> None:
    plan = written(home, PLAN)
    code, out, err = entrain(capfd, "close-loop", plan, "--sealed", "--minutes", "0.1")
    assert (code, err) == (1, "")
    assert "out_of_budget" in out
    assert "sealed truth" not in out
    assert "what is sealed stays so" in out
    code, out, _ = entrain(capfd, "close-loop", written(home, PLAN + AT_ONCE), "--sealed")
    assert code == 1
    assert "sealed truth" not in out
    assert "what is sealed stays so" in out
