"""One piece of work in a process of its own, given up when it takes too long.

A vendor's library that hangs in its own C code hangs its process, and nothing else can be done
about it than to end that process. It also sees the machine afresh: PortAudio lists devices only
once in a process.
"""

from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import TypeVar

from drivers.errors import DeviceLost, DeviceTimeout
from drivers.isolated_link import rig_context, rig_process
from drivers.isolated_process import portable

T = TypeVar("T")


def elsewhere(work: Callable[[], T], timeout_s: float, what: str) -> T:
    """What `work` returns; what it raises is raised here.

    Parameters
    ----------
    work : picklable, as its result must be.
    what : names the work in errors.

    Raises
    ------
    DeviceTimeout
        No answer within `timeout_s`; the process is ended.
    DeviceLost
        Its process ended by itself.
    """
    ours, theirs = rig_context().Pipe(duplex=False)
    process = rig_process(_run, work, theirs)
    process.start()
    theirs.close()  # or the pipe would not end with the process
    try:
        if not ours.poll(timeout_s):
            raise DeviceTimeout(f"{what}: no answer within {timeout_s:g} s; given up")
        value, error = ours.recv()
    except EOFError:
        raise DeviceLost(f"{what}: its process ended without an answer") from None
    finally:
        process.kill()
        process.join()
        process.close()
        ours.close()
    if error is not None:
        raise error
    result: T = value
    return result


def _run(work: Callable[[], T], pipe: Connection) -> None:
    try:
        pipe.send((work(), None))
    except Exception as error:
        pipe.send((None, portable(error)))
