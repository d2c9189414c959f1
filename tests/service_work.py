"""Work for the tests of jobs: runs in the job's own process."""

import os
import threading
from typing import Any

import numpy as np

from daq.service.jobs import Link


def double(link: Link, value: float) -> dict[str, Any]:
    link.progress(0.5, "half way")
    link.log(f"doubling {value}")
    link.event("wave", {"rate_hz": 4.0}, np.array([[value, 2 * value]]))
    return {"value": 2 * value, "process": os.getpid()}


def fail(link: Link) -> dict[str, Any]:
    raise ValueError("frequency_hz=-1 is not a finite frequency > 0")


def die(link: Link) -> dict[str, Any]:
    os._exit(7)


def wait(link: Link) -> dict[str, Any]:
    """Runs until it hears `emergency_stop` or `stop`."""
    over = threading.Event()
    reasons: list[str] = []
    for command in ("emergency_stop", "stop"):

        def heard(body: dict[str, Any], command: str = command) -> None:
            reasons.append(command)
            over.set()

        link.on(command, heard)
    link.progress(0.1, "waiting")
    over.wait(30)
    return {"heard": reasons}
