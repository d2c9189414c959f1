"""`docs/commands.md` from the commands themselves: each with its own help text.

``python -m daq.service.commands.document`` prints the page; a test keeps the file equal to it, so
that no command and no option is undocumented.
"""

from collections.abc import Iterator
from typing import Any

from daq.service.settings import Settings, leaves

HEAD = """# Commands and settings

Made from the commands by `python -m daq.service.commands.document`. `entrain --config FILE ...`
reads that configuration file, `--debug` shows the trace of an error. Exit codes: 0 done, 1 the work
failed, 2 what was asked is not possible as asked.
"""
WIDTH = 96


def commands(command: Any, words: str) -> Iterator[tuple[str, Any]]:
    """Every command below `command`, with the words that call it."""
    inner = getattr(command, "commands", None)
    if inner is None:
        yield words, command
        return
    for name, one in inner.items():
        yield from commands(one, f"{words} {name}")


def help_text(command: Any, words: str) -> str:
    """What ``--help`` prints."""
    context = command.context_class(
        command, info_name=words, terminal_width=WIDTH, max_content_width=WIDTH
    )
    text: str = command.get_help(context)
    return text


def page() -> str:
    """The whole of `docs/commands.md`."""
    import typer

    from daq.cli import app

    lines = [HEAD]
    for words, command in commands(typer.main.get_command(app), "entrain"):
        indented = "\n".join(
            f"    {line}".rstrip() for line in help_text(command, words).splitlines()
        )
        lines += [f"## {words}", "", indented, ""]
    lines += ["## Settings", "", "| setting | default | meaning |", "|---|---|---|"]
    for key, value, meaning in leaves(Settings.model_construct()):
        shown = "the user's data folder" if key == "data_dir" else value
        lines.append(f"| `{key}` | {shown} | {meaning} |")
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    print(page(), end="")
