"""Analyses over HTTP on a recorded campaign, from upload to report; needs the recorded cases."""

import shutil
from pathlib import Path

import pytest

from daq.client import ApiError, Client
from tests.service_live import running

CASE = Path(__file__).resolve().parents[2] / "shared" / "cases" / "a-clean"

pytestmark = [pytest.mark.shared, pytest.mark.timeout(400)]


def test_identify_over_http(tmp_path: Path) -> None:
    with running(tmp_path) as server, Client(server.url) as lab:
        folder = shutil.copytree(CASE, tmp_path / "a-clean")
        imported = lab.import_folder(folder)
        lab.wait(imported.id, 120)
        campaign = lab.result(imported.id)["campaign"]
        job = lab.identify(campaign)
        with pytest.raises(ApiError, match=r"is (queued|running)"):
            lab.identification(job.id)
        messages: list[str] = []
        lab.wait(job.id, 360, lambda seen: messages.append(seen.message))
        assert len(set(messages)) > 1  # progress was told
        found = lab.identification(job.id)
        assert found["format"] == "identification/1"
        assert found["converged"] is True
        # physics.md section 1: the tube's first mode is at 168.79 Hz.
        frequency = found["parameters"]["mode1.frequency_hz"]
        assert frequency["value"] == pytest.approx(168.79, abs=max(0.1, 4 * frequency["stderr"]))
        details = lab._ask("GET", f"/identifications/{job.id}/details").json()
        assert len(details["runs"]) == 11
        gain = details["curves"]["gain_db"]
        low, high, value = (gain[name] for name in ("low", "high", "value"))
        inside = [a <= v <= b for a, v, b in zip(low, value, high, strict=True)]
        assert sum(inside) > 0.95 * len(inside)
        report = lab.report(job.id, "identifications")
        assert "<script" not in report
        with pytest.raises(ApiError, match="no diagnosis"):
            lab.diagnosis(job.id)
