"""Processes beside the service's own: where work runs that must not stall it.

They are forked from a small server process that has imported the heavy libraries once and has
neither threads nor files of ours (multiprocessing's ``forkserver``); where a system lacks that,
they are spawned. So a job starts in milliseconds, and a first import of numba or SciPy never holds
up a request: an emergency stop has to get through.

`Aside` is one such process for short questions (what limits has this rig?), answered in order.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any, ParamSpec, TypeVar

Given = ParamSpec("Given")
Found = TypeVar("Found")
PRELOAD = ["daq.service.rig_work", "daq.service.rig_facts", "daq.service.analysis_work"]
ANSWER_S = 60.0
FORKSERVER = "forkserver" in multiprocessing.get_all_start_methods()
context: Any = multiprocessing.get_context("forkserver" if FORKSERVER else "spawn")
if FORKSERVER:
    context.set_forkserver_preload(PRELOAD)


def warm() -> None:
    """Start the server process now, so that its imports are done when the first job comes."""
    if FORKSERVER:
        from multiprocessing import forkserver, resource_tracker

        resource_tracker.ensure_running()  # would unblock the signal, were it started below
        # It inherits the mask: the terminal's Ctrl-C is for the service, also while it imports.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_service() -> None:
    """Make this process end when the service is killed.

    It holds both ends of the pipe on which it waits for questions, so it would wait for ever, and
    the server process that it was forked from with it.
    """
    service = multiprocessing.parent_process()
    assert service is not None

    def wait() -> None:
        service.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True, name="service").start()


class Aside:
    """One process that answers short questions."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._pool: ProcessPoolExecutor | None = None

    def ask(
        self, question: Callable[Given, Found], *args: Given.args, **kwargs: Given.kwargs
    ) -> Found:
        """What `question` returns there; its errors rise here. A process that died is replaced.

        Raises `TimeoutError` after `ANSWER_S`; a process that is stuck for so long is ended.
        """
        try:
            return self._submit(question, *args, **kwargs)
        except BrokenProcessPool:
            self.close()
            return self._submit(question, *args, **kwargs)

    def _submit(
        self, question: Callable[Given, Found], *args: Given.args, **kwargs: Given.kwargs
    ) -> Found:
        pool = self._executor()
        future = pool.submit(question, *args, **kwargs)
        try:
            return future.result(ANSWER_S)
        except TimeoutError:
            if future.running():  # else it waits its turn behind one that is stuck
                for process in list(pool._processes.values()):
                    process.kill()
            raise

    def close(self) -> None:
        """End the process; harmless twice."""
        with self._lock:
            pool, self._pool = self._pool, None
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)

    def _executor(self) -> ProcessPoolExecutor:
        with self._lock:
            if self._pool is None:
                self._pool = ProcessPoolExecutor(
                    1, mp_context=context, initializer=_end_with_service
                )
            return self._pool
