"""`entrain reproduce`: the thesis made again, on one page."""

import time
from pathlib import Path
from typing import Annotated

import typer

from daq.service.commands.analysis import progress_bar
from daq.service.commands.common import folder_to_be, out


def reproduce(
    folder: Annotated[
        Path, typer.Option("--out", help="Where reproduction.html goes.", callback=folder_to_be)
    ] = Path("entrain-reproduction"),
) -> None:
    """Make the thesis's tables and figures again, theirs beside ours, on one page.

    A quarter of an hour of computing, most of it for tracing what the re-enacted experiment lacks.
    """
    from daq.service.reproduce import reproduce as make

    started = time.monotonic()
    with progress_bar(quiet=False) as tell:
        path = make(folder, tell)
    out.print(f"wrote {path} ({time.monotonic() - started:.0f} s)", markup=False, soft_wrap=True)
