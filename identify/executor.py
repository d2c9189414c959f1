"""Where independent work runs: here, on this machine's cores, or on a Dask cluster.

`Executor.map` keeps order and passes exceptions on. What is mapped must be a module-level
function with picklable arguments.
"""

import functools
import importlib
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import get_all_start_methods, get_context, parent_process
from multiprocessing.context import BaseContext
from typing import Any, ParamSpec, Protocol, TypeVar

from threadpoolctl import threadpool_limits

T = TypeVar("T")
R = TypeVar("R")
P = ParamSpec("P")
Progress = Callable[[float, str], None]  # told the share done of a long work, and what is under way


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """`function` with linear algebra on one thread.

    Our matrices are small and many: more threads double the time spent and gain nothing; other
    cores are for other processes (an acquisition, the executor's workers).
    """

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited


class Executor(Protocol):
    """One verb."""

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]: ...


class InProcess:
    """One after another, here: the default."""

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        return map(function, items)


class _Pool:
    def __init__(self, pool: ProcessPoolExecutor) -> None:
        self.pool = pool

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        return self.pool.map(function, items)


class _Dask:
    def __init__(self, client: Any) -> None:
        self.client = client

    def map(self, function: Callable[[T], R], items: Iterable[T]) -> Iterator[R]:
        return iter(self.client.gather(self.client.map(function, list(items), pure=False)))


@contextmanager
def executor(processes: int = 1, dask_address: str | None = None) -> Iterator[Executor]:
    """An executor for the length of a block.

    ``processes`` > 1 uses that many worker processes (0: one a core); ``dask_address`` a Dask
    scheduler instead (``pip install entrain[cluster]``).
    """
    if dask_address is not None:
        try:
            from distributed import Client
        except ImportError as error:
            raise ImportError(
                "package missing: install entrain[cluster] to use a Dask cluster"
            ) from error
        with Client(dask_address) as client:
            yield _Dask(client)
        return
    count = processes or os.cpu_count() or 1
    if count == 1:
        yield InProcess()
        return
    with ProcessPoolExecutor(count, mp_context=_context(), initializer=_prepare) as pool:
        threading.Thread(target=_start, args=(pool, count), daemon=True).start()
        try:
            yield _Pool(pool)
        except BaseException:  # cancelled or failed: what has not begun never begins
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _start(pool: ProcessPoolExecutor, count: int) -> None:
    """Workers start at once, beside what comes before the first map: what they need takes seconds
    to load, for which whoever starts them waits."""
    with suppress(RuntimeError):  # all was over before
        for _ in range(count):
            pool.submit(os.getpid)


def _context() -> BaseContext:
    """Workers come of a process that has loaded what they need, where there is such a thing, and
    never of this one, which may have threads of its own."""
    if "forkserver" not in get_all_start_methods():
        return get_context("spawn")
    context = get_context("forkserver")
    context.set_forkserver_preload(["identify"])
    return context


def _prepare() -> None:
    """What every worker needs first."""
    importlib.import_module("identify")
    threadpool_limits(limits=1, user_api="blas")
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """A worker whose process was killed would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
