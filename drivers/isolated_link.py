"""What passes between a rig's own process and the service: messages, and a few shared numbers.

Calls and their replies, and the blocks, travel as pickles over two pipes. Feeding and silence do
not: they are numbers in shared memory, so that `silence()` waits for nobody and works from any
thread, also while another thread is in the middle of a call.
"""

import ctypes
import multiprocessing
import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from drivers.protocols import DuplexRig
from drivers.types import Block, Channel, OutputLimits, StreamStatus

Factory = Callable[[], DuplexRig]


class Board(ctypes.Structure):
    """Written by the service, looked at by the rig's process every few milliseconds.

    Each field has one writer side and is read on its own; nothing spans two of them.
    """

    _fields_ = (
        ("feeds", ctypes.c_uint64),
        ("silences", ctypes.c_uint64),
        ("stops", ctypes.c_uint64),
        ("reason", ctypes.c_char * 200),  # of the stop; written before `stops`
    )


@dataclass(frozen=True)
class Hello:
    """What the rig is, sent once it is open."""

    name: str
    channels: tuple[Channel, ...]
    sample_rate_hz: float
    limits: OutputLimits


@dataclass(frozen=True)
class Call:
    """A verb of the rig, the silences that the caller had asked for before, the stream it means."""

    verb: str
    arguments: tuple[Any, ...] = ()
    silences: int = 0
    stream: int = 0
    number: int = 0


@dataclass(frozen=True)
class Reply:
    """What the call of that number returned or raised, and the status and rate after it."""

    number: int
    value: Any
    error: Exception | None
    status: StreamStatus
    sample_rate_hz: float


@dataclass(frozen=True)
class Delivery:
    """A block, or the error that ended them; `stream` counts the starts."""

    stream: int
    block: Block | None
    error: Exception | None = None


def rig_context() -> Any:
    """How rig processes are made: clean ones, without a copy of the service's threads and files.

    A fork server, where there is one, has NumPy loaded already and opens a rig in a tenth of the
    time; it holds no end of the pipes, so these still end with the service.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["drivers.isolated_process"])
    return context


def rig_process(work: Callable[..., None], *arguments: Any) -> Any:
    """A process, not started yet, for `work`: it ends with this one, and has the environment of
    now, not that of the day the fork server began."""
    return rig_context().Process(
        target=_in_environment, args=(dict(os.environ), work, *arguments), daemon=True
    )


def _in_environment(
    environment: dict[str, str], work: Callable[..., None], *arguments: Any
) -> None:
    os.environ.clear()
    os.environ.update(environment)
    work(*arguments)


def new_board() -> Board:
    """Shared memory without a lock."""
    board: Board = rig_context().RawValue(Board)
    return board
