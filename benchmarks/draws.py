"""Many independent draws of a study: resumable, with a progress bar, within a CPU budget.

Each draw is one JSON line; a draw whose key stands in the file already is not done again. What is
mapped is a module-level function of one key.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

Record = dict[str, Any]


def run(
    name: str,
    keys: Sequence[Any],
    work: Callable[[Any], Record],
    out: Path | None,
    budget_cpu_s: float | None = None,
) -> list[Record]:
    """Records of `keys`, in order, as far as the budget of this process's CPU seconds goes.

    `work` returns a record; ``key`` and ``cpu_s`` are added to it.
    """
    known = {json.dumps(r["key"]): r for r in read(out)}
    todo = [k for k in keys if json.dumps(k) not in known]
    began = time.process_time()
    console = Console(stderr=True)
    columns = (TextColumn(name), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bar:
        task = bar.add_task(name, total=len(todo))
        for key in todo:
            if budget_cpu_s is not None and time.process_time() - began > budget_cpu_s:
                print(f"{name}: the budget of {budget_cpu_s:g} CPU s is used up", file=sys.stderr)
                break
            start = time.process_time()
            record = {"key": key, **work(key), "cpu_s": time.process_time() - start}
            known[json.dumps(key)] = record
            if out is not None:
                with out.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(record) + "\n")
            bar.advance(task)
    return [known[json.dumps(k)] for k in keys if json.dumps(k) in known]


def read(out: Path | None) -> list[Record]:
    """Records of earlier calls; a line cut off by a kill is dropped."""
    if out is None or not out.exists():
        return []
    records = []
    for line in out.read_text(encoding="utf-8").splitlines():
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records
