"""What every test sees: the markers that name what a test needs, and what happens without it.

``@pytest.mark.component("PortAudio")`` skips, naming the component and its install command, where
the machine lacks it. With ``ENTRAIN_REQUIRE_COMPONENTS=1`` (as `.ci/run` sets it) the same test
fails instead, so that nothing passes there by not having run.

Linear algebra is kept to one thread, here and in every process that a test starts: our matrices
are small, and the workers of `pytest -n` would fight over the cores.
"""

import ctypes.util
import importlib.util
import logging
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):  # read when NumPy is first imported
    os.environ.setdefault(threads, "1")

REQUIRE = "ENTRAIN_REQUIRE_COMPONENTS"
SLOW_S = 900.0  # limit of a test marked slow
SHARED = Path(__file__).resolve().parents[2] / "shared"


def _library(name: str) -> Callable[[], bool]:
    return lambda: ctypes.util.find_library(name) is not None


def _command(name: str) -> Callable[[], bool]:
    return lambda: shutil.which(name) is not None


def _module(name: str) -> Callable[[], bool]:
    return lambda: importlib.util.find_spec(name) is not None


def _chromium() -> bool:
    return any(shutil.which(name) for name in ("chromium", "chromium-browser", "google-chrome"))


# name -> (is it there?, how to get it)
COMPONENTS: dict[str, tuple[Callable[[], bool], str]] = {
    "PortAudio": (_library("portaudio"), "apt install libportaudio2"),
    "PulseAudio": (
        _command("pulseaudio"),
        "apt install pulseaudio pulseaudio-utils libasound2-plugins",
    ),
    "JACK": (_command("jackd"), "apt install jackd2"),
    "socat": (_command("socat"), "apt install socat"),
    "openssl": (_command("openssl"), "apt install openssl"),
    "Chromium": (_chromium, "apt install chromium"),
    "pyvisa-sim": (_module("pyvisa_sim"), "pip install pyvisa-sim"),
}


def _missing(item: pytest.Item) -> str | None:
    """What the machine lacks for this test; `None` when nothing."""
    for mark in item.iter_markers("component"):
        for name in mark.args:
            present, remedy = COMPONENTS[name]
            if not present():
                return f"{name} not found: {remedy}"
    return None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:  # two minutes of a good machine are more than pytest's limit of another
        if item.get_closest_marker("slow") is not None:
            item.add_marker(pytest.mark.timeout(SLOW_S))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    missing = _missing(item)
    if missing is not None:
        if os.environ.get(REQUIRE) == "1":
            pytest.fail(f"{missing} (required by {REQUIRE}=1)", pytrace=False)
        pytest.skip(missing)
    if item.get_closest_marker("shared") is not None and not SHARED.is_dir():
        pytest.skip(f"recorded material not found: {SHARED}")


@pytest.fixture(autouse=True)
def _own_logs() -> Iterator[None]:
    """What a command sends to its standard error ends with the test that has taken that over."""
    loggers = [logging.getLogger(name) for name in ("entrain", "uvicorn")]
    before = [(x, x.handlers[:], x.level, x.propagate) for x in loggers]
    yield
    for logger, handlers, level, propagate in before:
        logger.handlers = handlers
        logger.setLevel(level)
        logger.propagate = propagate
