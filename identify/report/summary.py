"""The result as plain text for a terminal or a log: the same tables and words as the page."""

from collections.abc import Mapping, Sequence
from typing import Any

from identify.report import sections, words
from identify.report.equations import equations_text
from identify.report.gallery import Result, assessments
from identify.results import Diagnosis, Identification

WIDTH = 96
MOST = 10  # candidates listed
ALWAYS = 7  # columns of the candidates that stand even where empty


def summary_text(result: Result, truth: Mapping[str, Any] | None = None) -> str:
    """Verdict, errors before and after, limit cycle, effects, candidates, parameters, next step."""
    found = words.heading(result)
    heads = [name for name, _ in sections.columns(result)]
    blocks = [
        "\n".join([found.headline, *(wrapped(line) for line in found.evidence)]),
        plain_table(["", *heads], sections.error_rows(result), right=range(1, len(heads) + 1)),
        _cycle(result),
        _validation(result),
        _quality(result),
        _candidates(result),
        _parameters(result, heads),
        "Model\n" + equations_text(_final(result)),
        _next(result),
    ]
    if truth:
        rows = [[k, v] for k, v in sections.flat(truth)]
        blocks.append("Sealed truth\n" + plain_table(["", ""], rows))
    return "\n\n".join(b for b in blocks if b) + "\n"


def plain_table(
    head: Sequence[str], rows: Sequence[Sequence[str]], right: Sequence[int] = ()
) -> str:
    """Columns padded to their widest entry, two spaces apart, a rule under the head."""
    lines = [list(head), *(list(r) for r in rows)]
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]

    def one(line: Sequence[str]) -> str:
        cells = [
            c.rjust(w) if i in right else c.ljust(w)
            for i, (c, w) in enumerate(zip(line, widths, strict=True))
        ]
        return "  ".join(cells).rstrip()

    rule = "  ".join("─" * w for w in widths)
    return "\n".join([*([one(head), rule] if any(head) else []), *(one(r) for r in rows)])


def wrapped(line: str, indent: str = "  ") -> str:
    from textwrap import fill

    return fill(line, WIDTH, initial_indent=indent, subsequent_indent=indent)


def _final(result: Result) -> Any:
    before, after = assessments(result)
    return before if after is None else after


def _cycle(result: Result) -> str:
    rows = sections.cycle_rows(result)
    return plain_table(sections.CYCLE_HEAD, rows, right=(1, 2)) if rows else ""


def _validation(result: Result) -> str:
    final = _final(result)
    if not final.fit.converged:
        return ""
    blocks = [
        plain_table(head, rows, right)
        for head, rows, right in (
            (sections.LOCK_IN_HEAD, sections.lock_in_rows(final), (1, 2, 3, 4)),
            (sections.PREDICTION_HEAD, sections.prediction_rows(final), (1, 2, 3, 4)),
            (sections.RESIDUAL_TEST_HEAD, sections.residual_test_rows(final), (2, 3)),
        )
        if rows
    ]
    return "\n\n".join(blocks)


def _quality(result: Result) -> str:
    rows = [[q.run, q.flag, q.severity.replace("_", "-"), q.detail] for q in result.quality]
    return plain_table(["run", "flag", "consequence", "detail"], rows) if rows else ""


def _candidates(result: Result) -> str:
    if not isinstance(result, Diagnosis) or not result.candidates:
        return ""
    rows = sections.candidate_rows(result)[:MOST]
    head = ["valid. error" if h == "validation error" else h for h in sections.CANDIDATE_HEAD]
    used = [i for i in range(len(head)) if i < ALWAYS or any(row[i] for row in rows)]
    table = plain_table(
        [head[i] for i in used], [[row[i] for i in used] for row in rows], right=(2, 3, 4)
    )
    more = len(result.candidates) - MOST
    return table + (f"\n… and {more} more" if more > 0 else "")


def _parameters(result: Result, heads: Sequence[str]) -> str:
    columns = ["parameter", "unit"]
    for name in heads:
        columns += [name, "s.e."]
    rows = sections.parameter_rows(result)
    if not rows:
        return ""
    notes = sections.interval_notes(result)
    if isinstance(result, Identification) and result.undetermined:
        notes.append(f"Not determined by these data: {words.joined(result.undetermined)}.")
    return "\n".join(
        [plain_table(columns, rows, right=range(2, len(columns))), *(wrapped(n) for n in notes)]
    )


def _next(result: Result) -> str:
    if not isinstance(result, Diagnosis) or not result.next_experiment:
        return ""
    rows = [[k, v] for k, v in sections.flat(sections.told(result.next_experiment))]
    return "Next experiment\n" + plain_table(["", ""], rows)
