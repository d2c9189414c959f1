"""What the commands share: the console, the store in force, tables, JSON files, errors' exits."""

import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from daq.store import RunStore

out = Console(highlight=False, emoji=False)
err = Console(stderr=True, highlight=False, emoji=False)

FIGURES = (".png", ".svg", ".pdf")
StoreOption = Annotated[
    Path | None, typer.Option("--store", help="Run store; else the configured one.")
]


def writable(place: Path | None) -> Path | None:
    """Refuse a place that cannot be written to before the work that it is for."""
    if place is None or str(place) == "-":
        return place
    if place.is_dir() or not place.parent.is_dir():
        what = "a folder" if place.is_dir() else f"in no folder: {place.parent} does not exist"
        raise typer.BadParameter(f"{str(place)!r} is {what}; give a file in a folder that exists")
    if not os.access(place if place.exists() else place.parent, os.W_OK):
        raise typer.BadParameter(f"{str(place)!r} may not be written; give another place")
    return place


def _drawable(place: Path | None) -> Path | None:
    """Refuse a figure of another format than we draw, too."""
    if place is not None and place.suffix.lower() not in FIGURES:
        raise typer.BadParameter(f"{str(place)!r} does not end in {', '.join(FIGURES)}")
    return writable(place)


def folder_to_be(place: Path) -> Path:
    """Refuse what cannot become a folder before the work whose results it is for."""
    above = next(one for one in (place, *place.absolute().parents) if one.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        what = "may not be written to" if above.is_dir() else "is a file"
        raise typer.BadParameter(f"{str(above)!r} {what}; give a folder, or where one can be made")
    return place


def finite(value: float | None) -> float | None:
    """Refuse NaN and infinity, which are numbers to the parser."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"{value} is not a finite number")
    return value


def positive(value: float | None) -> float | None:
    """Refuse what is no finite number above zero."""
    if value is not None and not 0 < value < math.inf:
        raise typer.BadParameter(f"{value} is not a finite number > 0")
    return value


JsonOption = Annotated[
    Path | None,
    typer.Option("--json", help="Also write the result as JSON; - for stdout.", callback=writable),
]
HtmlOption = Annotated[
    Path | None,
    typer.Option("--html", help="Also write a self-contained HTML report.", callback=writable),
]
FigureOption = Annotated[
    Path | None,
    typer.Option("--figure", help="Also write a figure (.png, .svg, .pdf).", callback=_drawable),
]
PlanOption = Annotated[
    Path, typer.Option("--out", help="Where the plan goes; - for stdout.", callback=writable)
]


_config: ContextVar[Path | None] = ContextVar("config", default=None)


def use_config(path: Path | None) -> None:
    """Remember the ``--config`` of this call."""
    _config.set(path)


def config_file() -> Path | None:
    """The ``--config`` of this call."""
    return _config.get()


@contextmanager
def open_store(place: Path | None) -> Iterator["RunStore"]:
    """The store at `place`, or the configured one."""
    from daq.store import RunStore

    if place is None:
        from daq.service.settings import load

        place = load(config_file()).store_dir
    store = RunStore(place)
    try:
        yield store
    finally:
        store.close()


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Print a table; every cell is text, never markup."""
    shown = Table(title=escape(title) or None, title_justify="left")
    for index, column in enumerate(columns):
        shown.add_column(column, no_wrap=index == 0, overflow="fold")
    for row in rows:
        shown.add_row(*(escape("" if cell is None else str(cell)) for cell in row))
    out.print(shown)


def indented(text: str, spaces: int, style: str = "") -> None:
    """Print a paragraph so far to the right, wrapped at words; nothing for no text."""
    if text:
        out.print(Padding(Text(text, style), (0, 0, 0, spaces)))


def number(value: float | None, digits: int = 4) -> str:
    """A number as tables show it."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def write_json(place: Path | None, content: dict[str, Any]) -> None:
    """Write `content` to `place`, or to stdout for ``-``; nothing for None. What is no finite
    number is null."""
    from daq.errors import unwritable
    from daq.service.plain import plain

    if place is None:
        return
    to_terminal = str(place) == "-"
    ascii_ = to_terminal and not sys.stdout.encoding.lower().startswith("utf")
    text = json.dumps(plain(content), indent=2, ensure_ascii=ascii_, allow_nan=False)
    if to_terminal:
        sys.stdout.write(text + "\n")
        return
    try:
        place.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        if place.is_file():
            place.unlink()  # a part of the answer is none
        raise unwritable(place, error) from error
