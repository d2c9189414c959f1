"""A thin typed client of the REST API.

>>> with Client("http://127.0.0.1:8000") as lab:                        # doctest: +SKIP
...     job = lab.start("simulated", {"title": "around the limit cycle"})
...     lab.wait(job.id)
...     diagnosis = lab.wait(lab.diagnose(job.about["campaign"]).id)
...     print(lab.diagnosis(diagnosis.id)["verdict"])

Answers are the API's own models (`daq.service.wire`); refusals raise `ApiError` with the problem's
words. `take_control` remembers the lock's token and sends it with every command to that rig.
"""

import io
import json
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import httpx
from pydantic import BaseModel

from daq.service import wire


class ApiError(Exception):
    """The service refused or failed: `status`, `kind` (the problem's type) and its words."""

    def __init__(self, answer: httpx.Response) -> None:
        try:
            body = answer.json()
        except ValueError:
            body = {}
        self.status = answer.status_code
        self.kind = str(body.get("type", ""))
        self.body = body
        super().__init__(body.get("detail") or f"HTTP {answer.status_code}")


class JobFailed(Exception):
    """A job that was waited for did not succeed."""


class Client:
    """The API at `url`; `key` where it asks for one."""

    def __init__(self, url: str, key: str | None = None, timeout_s: float = 60.0) -> None:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        base = f"{url.rstrip('/')}/api/v1"
        self._http = httpx.Client(base_url=base, headers=headers, timeout=timeout_s)
        self._tokens: dict[str, str] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._http.close()

    def _ask(
        self,
        method: str,
        path: str,
        *,
        rig: str | None = None,
        body: BaseModel | None = None,
        content: bytes | None = None,
        **query: Any,
    ) -> httpx.Response:
        headers = {}
        if rig is not None and (token := self._tokens.get(rig)):
            headers["X-Control-Token"] = token
        answer = self._http.request(
            method,
            path,
            headers=headers,
            params={name: value for name, value in query.items() if value is not None},
            json=body.model_dump(exclude_none=True) if body is not None else None,
            content=content,
        )
        if answer.is_error:
            raise ApiError(answer)
        return answer

    # the service

    def health(self) -> wire.Health:
        return wire.Health(**self._ask("GET", "/health").json())

    def version(self) -> wire.Version:
        return wire.Version(**self._ask("GET", "/version").json())

    def devices(self) -> list[wire.Device]:
        return [wire.Device(**row) for row in self._ask("GET", "/devices").json()]

    # rigs

    def rigs(self) -> list[wire.Rig]:
        return [wire.Rig(**row) for row in self._ask("GET", "/rigs").json()]

    def rig(self, name: str) -> wire.Rig:
        return wire.Rig(**self._ask("GET", f"/rigs/{name}").json())

    def add_simulated_rig(self, rig: wire.SimulatedRigRequest) -> wire.Rig:
        return wire.Rig(**self._ask("POST", "/simulated-rigs", body=rig).json())

    def take_control(self, rig: str, takeover: bool = False) -> wire.Lock:
        """Take (or renew) the rig's lock and use it from here on."""
        body = wire.LockRequest(takeover=takeover)
        lock = wire.Lock(**self._ask("POST", f"/rigs/{rig}/lock", rig=rig, body=body).json())
        self._tokens[rig] = lock.token
        return lock

    def give_control_back(self, rig: str) -> None:
        self._ask("DELETE", f"/rigs/{rig}/lock", rig=rig)
        self._tokens.pop(rig, None)

    def emergency_stop(self, rig: str | None = None) -> wire.Stopped:
        """Silence one rig, or all."""
        path = "/emergency-stop" if rig is None else f"/rigs/{rig}/emergency-stop"
        return wire.Stopped(**self._ask("POST", path).json())

    def reset(self, rig: str) -> wire.Rig:
        return wire.Rig(**self._ask("POST", f"/rigs/{rig}/reset", rig=rig).json())

    # calibrations

    def calibrations(self, **filters: Any) -> Iterator[wire.Calibration]:
        """All calibrations, newest first; filters are `subject` and `method`."""
        return self._pages("/calibrations", wire.Calibration, **filters)

    def add_calibration(self, calibration: wire.CalibrationUpload) -> wire.Calibration:
        return wire.Calibration(**self._ask("POST", "/calibrations", body=calibration).json())

    def calibration_of(self, rig: str) -> wire.RigCalibration:
        """What a campaign on the rig would use now, and what is missing or stale."""
        return wire.RigCalibration(**self._ask("GET", f"/rigs/{rig}/calibrations").json())

    # campaigns

    def dry_run(
        self, rig: str, plan: dict[str, Any], free_frequency_hz: float | None = None
    ) -> wire.DryRun:
        body = wire.CampaignRequest(rig=rig, plan=plan, free_frequency_hz=free_frequency_hz)
        return wire.DryRun(**self._ask("POST", "/campaigns/dry-run", body=body).json())

    def start(self, rig: str, plan: dict[str, Any]) -> wire.JobSummary:
        """Queue a campaign; its id is ``job.about["campaign"]``."""
        body = wire.CampaignRequest(rig=rig, plan=plan)
        return wire.JobSummary(**self._ask("POST", "/campaigns", rig=rig, body=body).json())

    def steer(self, job: wire.JobSummary, command: str) -> wire.JobSummary:
        """``pause``, ``resume``, ``skip`` or ``stop`` a campaign's job."""
        answer = self._ask("POST", f"/jobs/{job.id}/{command}", rig=job.about.get("rig"))
        return wire.JobSummary(**answer.json())

    def campaigns(self, verdict: str | None = None) -> Iterator[wire.Campaign]:
        """All campaigns, page by page."""
        return self._pages("/campaigns", wire.Campaign, verdict=verdict)

    def campaign(self, campaign: str) -> wire.CampaignDetail:
        return wire.CampaignDetail(**self._ask("GET", f"/campaigns/{campaign}").json())

    def runs(self, **filters: Any) -> Iterator[wire.Run]:
        """All runs that match the filters, page by page."""
        return self._pages("/runs", wire.Run, **filters)

    def _pages(self, path: str, model: Callable[..., Any], **query: Any) -> Iterator[Any]:
        after = None
        while True:
            page = self._ask("GET", path, after=after, limit=200, **query).json()
            for row in page["items"]:
                yield model(**row)
            after = page["next"]
            if after is None:
                return

    def samples(
        self, campaign: str, run: str, start: int = 0, stop: int | None = None
    ) -> wire.Slice:
        path = f"/campaigns/{campaign}/runs/{run}/samples"
        return wire.Slice(**self._ask("GET", path, start=start, stop=stop).json())

    def spectrum(self, campaign: str, run: str, channel: str | None = None) -> wire.Spectrum:
        path = f"/campaigns/{campaign}/runs/{run}/spectrum"
        return wire.Spectrum(**self._ask("GET", path, channel=channel).json())

    def download(self, campaign: str, run: str, target: Path, form: str = "hdf5") -> Path:
        """Stream a run to a file; `form` is hdf5, csv, npz or mat."""
        return self._save(f"/campaigns/{campaign}/runs/{run}/download", target, format=form)

    def _save(self, path: str, target: Path, **query: Any) -> Path:
        with self._http.stream("GET", path, params=query) as answer:
            if answer.is_error:
                answer.read()
                raise ApiError(answer)
            with target.open("wb") as sink:
                for piece in answer.iter_bytes():
                    sink.write(piece)
        return target

    def export(self, campaign: str) -> wire.JobSummary:
        """Write a campaign as one zip; `save_export` fetches it when the job is done."""
        return wire.JobSummary(**self._ask("POST", f"/campaigns/{campaign}/exports").json())

    def save_export(self, job: str, target: Path) -> Path:
        return self._save(f"/exports/{job}", target)

    def verify(self, campaign: str | None = None) -> wire.JobSummary:
        """Compare every run (of a campaign) with its checksum; the result has ``findings``."""
        return wire.JobSummary(**self._ask("POST", "/store/verify", campaign=campaign).json())

    def import_folder(self, folder: Path) -> wire.JobSummary:
        """Upload a campaign folder."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            for path in sorted(p for p in folder.rglob("*") if p.is_file()):
                archive.write(path, path.relative_to(folder).as_posix())
        name = f"{folder.name}.zip"
        return wire.JobSummary(
            **self._ask("POST", "/imports", name=name, content=buffer.getvalue()).json()
        )

    # jobs and analyses

    def jobs(self, **filters: Any) -> Iterator[wire.JobSummary]:
        return self._pages("/jobs", wire.JobSummary, **filters)

    def job(self, job: str) -> wire.JobSummary:
        return wire.JobSummary(**self._ask("GET", f"/jobs/{job}").json())

    def log(self, job: str) -> list[str]:
        lines: list[str] = self._ask("GET", f"/jobs/{job}/log").json()
        return lines

    def result(self, job: str) -> dict[str, Any]:
        found: dict[str, Any] = self._ask("GET", f"/jobs/{job}/result").json()
        return found

    def cancel(self, job: str) -> wire.JobSummary:
        return wire.JobSummary(**self._ask("DELETE", f"/jobs/{job}").json())

    def wait(
        self,
        job: str,
        timeout_s: float = 3600.0,
        tell: Callable[[wire.JobSummary], None] | None = None,
        poll_s: float = 0.2,
    ) -> wire.JobSummary:
        """Until the job has succeeded; raises `JobFailed` otherwise, `TimeoutError` when late."""
        end = time.monotonic() + timeout_s
        while True:
            seen = self.job(job)
            if tell is not None:
                tell(seen)
            if seen.state == "succeeded":
                return seen
            if seen.state in ("failed", "cancelled"):
                raise JobFailed(f"{seen.title}: {seen.state}: {seen.error}")
            if time.monotonic() > end:
                raise TimeoutError(f"{seen.title}: {seen.state} after timeout_s={timeout_s:g}")
            time.sleep(poll_s)

    def identify(self, campaign: str) -> wire.JobSummary:
        return wire.JobSummary(**self._ask("POST", f"/campaigns/{campaign}/identifications").json())

    def identification(self, job: str) -> dict[str, Any]:
        """`identification/1`."""
        found: dict[str, Any] = self._ask("GET", f"/identifications/{job}").json()
        return found

    def diagnose(self, campaign: str) -> wire.JobSummary:
        return wire.JobSummary(**self._ask("POST", f"/campaigns/{campaign}/diagnoses").json())

    def diagnosis(self, job: str) -> dict[str, Any]:
        """`diagnosis/1`."""
        found: dict[str, Any] = self._ask("GET", f"/diagnoses/{job}").json()
        return found

    def report(self, job: str, kind: str = "diagnoses") -> str:
        """The HTML report; `kind` is ``diagnoses`` or ``identifications``."""
        return self._ask("GET", f"/{kind}/{job}/report").text

    # live

    def live(self, since: int | None = None, kinds: str | None = None) -> Iterator[dict[str, Any]]:
        """Events as they happen; ends with the connection. Resume with the last `seq`."""
        query = {k: v for k, v in {"since": since, "kinds": kinds}.items() if v is not None}
        with self._http.stream("GET", "/live/events", params=query, timeout=None) as answer:
            if answer.is_error:
                answer.read()
                raise ApiError(answer)
            for line in answer.iter_lines():
                if line.startswith("data: "):
                    yield json.loads(line.removeprefix("data: "))
