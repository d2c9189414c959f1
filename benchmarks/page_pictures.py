"""The pictures of the page in `docs/`: ``python benchmarks/page_pictures.py [--out DIR]``.

Serves a store with two recorded campaigns and a rig in real time, lets Chromium walk through the
views, and saves what it sees. Needs Chromium (`.ci/components`) and takes about two minutes.
"""

import argparse
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from daq.importers import import_folder  # noqa: E402
from daq.service.settings import RigSettings  # noqa: E402
from tests.service_live import Running, running  # noqa: E402

RIGS = {
    "tube in real time": RigSettings(options={"clock": "realtime"}),
    "delayed flame": RigSettings(options={"effects": {"flame_delay": {"delay_s": 4e-4}}}),
}
FLAGS = ["--no-sandbox", "--disable-dev-shm-usage", "--disable-gpu"]
PLAN = {
    "title": "around the limit cycle",
    "record_s": 1.0,
    "conditions": [{"offset": x / 100, "over_threshold": 2.0} for x in (-5, -3, -1.5, 1.5, 3, 5)],
}

LOOP = {
    "title": "close the loop",
    "record_s": 1.0,
    "conditions": [
        {"offset": x / 100, "over_threshold": y, "role": "validation" if k in (3, 6) else "fit"}
        for k, (x, y) in enumerate(
            zip((-5, -4, -3, -2, -1, 1, 2, 3, 4, 5), (1.4, 2.2, 3) * 4, strict=False)
        )
    ],
}


def done(client: Any, job: str) -> None:
    """Wait for a job; it must succeed."""
    while (state := client.get(f"/jobs/{job}").json())["state"] in ("queued", "running"):
        time.sleep(0.5)
    assert state["state"] == "succeeded", state


def walk(page: Any, server: Running, shot: Callable[..., None]) -> None:
    """Every view, at its most telling."""

    def go(place: str, sign: str) -> None:
        page.goto(f"{server.url}/#{place}")
        page.wait_for_selector(sign, timeout=60_000)

    with server.client() as client:
        (campaign,) = [c["id"] for c in client.get("/campaigns").json()["items"]]
        jobs = [
            client.post(f"/campaigns/{campaign}/{kind}").json()["id"]
            for kind in ("identifications", "diagnoses")
        ]
        live = client.post("/campaigns", json={"rig": "tube in real time", "plan": PLAN}).json()
        go("live/tube%20in%20real%20time", "text=condition 3: going to")
        page.wait_for_selector("text=condition 3: entrained with", timeout=120_000)
        page.wait_for_timeout(600)
        shot("live")
        page.click("#theme")
        page.wait_for_timeout(400)
        shot("live-dark")
        page.click("#theme")
        go("new", "#dryrun")
        page.click("#dryrun")
        page.wait_for_selector("text=Nothing stands against it", timeout=60_000)
        shot("new")
        key = {"name": "control room", "scopes": ["read", "control"], "expires_days": 90}
        client.post("/keys", json=key)
        revoked = client.post("/keys", json={"name": "night shift", "scopes": ["read"]}).json()
        client.delete(f"/keys/{revoked['id']}")
        go("admin", "text=control room")
        shot("admin")
        go("rigs", "text=Simulated rig's console")
        page.select_option("select[name=effect]", "flame_delay")
        shot("rigs")
        for job in (*jobs, live["id"]):
            done(client, job)
        loop = client.post("/close-loops", json={"rig": "delayed flame", "plan": LOOP}).json()
        done(client, loop["id"])
        go(f"result/{loop['id']}", "#verdict")
        shot("closed-loop")
        go(f"result/{jobs[0]}", "text=Nyquist")
        shot("identification")
        go(f"result/{jobs[1]}", "#verdict")
        page.wait_for_timeout(300)
        shot("diagnosis")
        go("history", "text=around the limit cycle")
        shot("history")
        go(f"campaign/{live['about']['campaign']}", "text=Conditions")
        shot("campaign")
        page.click("a:has-text('001-forced')")
        page.wait_for_selector("text=samples a point")
        for _ in range(2):
            page.click("[aria-label='Zoom in']")
        page.wait_for_timeout(500)
        shot("run")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    parser.add_argument("--case", type=Path, default=ROOT / "tests" / "data" / "b-flame-delay")
    parser.add_argument("--dark", action="store_true", help="every view in dark")
    options = parser.parse_args()
    from playwright.sync_api import sync_playwright

    with (
        tempfile.TemporaryDirectory() as folder,
        running(Path(folder) / "data", rigs=RIGS) as server,
        sync_playwright() as playwright,
    ):
        import_folder(options.case, server.service.store)
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), headless=True, args=FLAGS
        )
        page = browser.new_page(
            viewport={"width": 1400, "height": 950},
            color_scheme="dark" if options.dark else "light",
        )
        page.goto(server.url)
        page.wait_for_selector("#connection.good", timeout=60_000)

        def shot(name: str) -> None:
            page.screenshot(path=options.out / f"{name}.png", full_page=True)
            print(options.out / f"{name}.png", flush=True)

        walk(page, server, shot)
        browser.close()


if __name__ == "__main__":
    main()
