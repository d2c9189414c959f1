"""One reproduced table or figure: theirs beside ours, and what differs and why."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from identify.report.page import paragraphs, table, tag, text

Status = Literal["reproduced", "reproduced in part", "stand-in"]


@dataclass(frozen=True)
class Item:
    """`covers` are the thesis's numbers (``Fig. 4.4``, ``Table 4.3``); `body` is HTML.

    `verdict` is one sentence for the overview.
    """

    name: str
    title: str
    covers: tuple[str, ...]
    status: Status
    verdict: str
    body: str

    def html(self) -> str:
        return tag("section", tag("h3", text(self.title)), self.body, id=self.name)


def compared(rows: Iterable[Sequence[object]], caption: str = "") -> str:
    """Quantity, the thesis's value, ours, the difference."""
    head = ("quantity", "thesis", "here", "difference")
    return table(head, rows, caption, numeric=(1, 2, 3))


def because(*lines: str) -> str:
    """What differs and why."""
    return paragraphs(lines)


def share(theirs: float, ours: float) -> str:
    """Relative difference, in per cent."""
    change = 100 * (ours / theirs - 1)
    return "0 %" if abs(change) < 5e-4 else f"{change:+.2g} %"
