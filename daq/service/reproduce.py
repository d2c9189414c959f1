"""`entrain reproduce`: every table and figure of the thesis that can be made again, on one page.

The rig's code makes the data (orbits by harmonic balance, time stepping), identification's code
analyses them; here they meet, and the thesis's numbers stand beside. The thesis's figures are
pictures in a scanned text: numbers, axis ranges and statements are compared, not curves.
"""

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from daq.service.reproduction import experiment, identification, model, residuals, theory, tracing
from daq.service.reproduction.item import Item
from identify.report.page import page, paragraphs, section, table, tag, text

Progress = Callable[[float, str], None]
Maker = Callable[[], Item]

CHAPTERS: tuple[tuple[str, tuple[Maker, ...]], ...] = (
    ("Chapter 1: the tube", experiment.INTRODUCTION),
    ("Chapters 2 and 3: theory", theory.ITEMS),
    ("Chapter 4: the model and its data", model.ITEMS),
    ("Chapter 4: identification of the model", (*identification.ITEMS, *model.COMPARISON)),
    (
        "Chapter 5: the experiment, re-enacted on a stand-in",
        (*experiment.ITEMS, residuals.residual_dynamics, tracing.tracing),
    ),
)

# Everything that rests on computation or data and is asked for.
WANTED = (
    *(f"Fig. {n}" for n in ("1.3", "2.4", "2.5", "2.6", "2.9", "2.10", "2.11", "3.3")),
    *(f"Fig. 4.{n}" for n in (1, 4, 5, *range(9, 16))),
    *(f"Fig. {n}" for n in ("5.3", "5.4", "5.6", "5.7")),
    *(f"Table {n}" for n in ("2.3", "2.4", *(f"4.{i}" for i in range(1, 8)))),
    *(f"Table {n}" for n in ("5.2", "5.3", "5.4")),
)


def reproduce(out_dir: Path, progress: Progress | None = None) -> Path:
    """Write ``reproduction.html`` into `out_dir` and return its path.

    Parameters
    ----------
    progress : called with (share done, what is being made).
    """
    began = time.monotonic()
    makers = [(chapter, make) for chapter, group in CHAPTERS for make in group]
    made: dict[str, list[Item]] = {chapter: [] for chapter, _ in CHAPTERS}
    for i, (chapter, make) in enumerate(makers):
        if progress is not None:
            what = " ".join((make.__doc__ or make.__name__).split())
            progress(i / len(makers), what)
        made[chapter].append(make())
    if progress is not None:
        progress(1.0, "page written")
    out_dir.mkdir(parents=True, exist_ok=True)
    path = out_dir / "reproduction.html"
    path.write_text(html(made, time.monotonic() - began), encoding="utf-8")
    return path


def missing(items: Sequence[Item]) -> tuple[str, ...]:
    """What is asked for and in none of `items`."""
    covered = {name for item in items for name in item.covers}
    return tuple(name for name in WANTED if name not in covered)


def html(made: dict[str, list[Item]], seconds: float) -> str:
    """The page of all items, with an overview in front."""
    items = [item for group in made.values() for item in group]
    head = tag("p", "entrain reproduce", class_="over") + tag("h1", text(TITLE))
    absent = missing(items)
    left = [f"Not on this page: {', '.join(absent)}."] if absent else []
    overview = section(
        "Overview",
        _overview(items),
        paragraphs([*left, NOT_MADE, f"Made in {seconds:.0f} s."]),
    )
    chapters = [section(name, *(i.html() for i in group)) for name, group in made.items()]
    return page(TITLE, head, paragraphs(INTRODUCTION), overview, *chapters)


def _overview(items: Sequence[Item]) -> str:
    rows = [
        tag(
            "tr",
            tag(
                "td", tag("a", text(", ".join(i.covers) or "beyond the thesis"), href=f"#{i.name}")
            ),
            tag("td", text(i.status)),
            tag("td", text(i.verdict)),
        )
        for i in items
    ]
    head = table(("tables and figures", "status", "in one line"), ())
    return head.replace("<tbody></tbody>", tag("tbody", *rows))


TITLE = "The thesis made again: limit cycles of a thermoacoustic model and their identification"
INTRODUCTION = (
    "B. A. Eisenhower, Identification of Thermoacoustic Dynamics Exhibiting Limit Cycle Behavior, "
    "Virginia Tech, 2000: its tables and figures computed afresh, with the thesis's numbers beside "
    "ours. Data come from the simulated rig (orbits by harmonic balance checked against time "
    "stepping), analyses from the identification library; the two share no code.",
    "The thesis is at hand as a scanned text: its figures' curves are not, their axes, captions "
    "and the statements about them are. Where only those can be compared, the table says so.",
)
NOT_MADE = (
    "Drawings and photographs (Figs. 1.1, 1.2, 1.4, 2.3, 2.7, 2.8, 3.1, 3.2, 4.2, 4.3, 4.6 to 4.8, "
    "4.16, 5.1, 5.2, 5.5), the sketches of Figs. 1.5, 2.1 and 2.2, and Tables 2.1, 2.2 and 5.1, "
    "which hold definitions and settings, are not made again. Measured data of Chapter 5 were not "
    "published; a simulated stand-in takes their place."
)
