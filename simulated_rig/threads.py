"""Linear algebra on one thread, for matrices so small that threads only wait for each other.

A monodromy matrix of the two-mode tube takes 3 ms of one core, and 350 ms of two with the library's
own threads.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from threadpoolctl import ThreadpoolController

P = ParamSpec("P")
R = TypeVar("R")


@functools.cache
def _libraries() -> ThreadpoolController:
    import scipy.linalg  # noqa: F401  (brings a library of its own, which must be loaded by now)

    return ThreadpoolController()


def one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """`function` with linear algebra on one thread."""

    @functools.wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with _libraries().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return limited
