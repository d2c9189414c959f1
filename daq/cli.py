"""`entrain`: the command line. It parses, calls and formats; the work is elsewhere.

Exit codes: 0 done, 1 the work failed, 2 what was asked is not possible as asked. Errors are one
line on standard error; ``--debug`` shows the trace instead.
"""

import errno
import sys
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer

from daq.service.commands import (
    analysis,
    data,
    demo,
    design,
    effects,
    hil,
    keys,
    loop,
    reproduce,
    rig,
    serving,
)
from daq.service.commands.common import use_config

app = typer.Typer(
    name="entrain",
    help="Entrain a self-excited oscillation, identify the loop inside it, "
    "and trace what the model lacks.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
campaign_app = typer.Typer(help="Campaigns on a rig, and those recorded.", no_args_is_help=True)

app.command("demo")(demo.demo)
app.command("import")(data.import_)
app.command("identify")(analysis.identify)
app.command("diagnose")(analysis.diagnose)
app.command("effects")(effects.effects)
app.command("close-loop")(loop.close_loop)
app.command("characterise")(analysis.characterise)
app.command("check")(rig.check)
app.command("devices")(rig.devices)
campaign_app.command("run")(rig.run)
campaign_app.command("dry-run")(rig.rehearse)
campaign_app.command("design")(design.design)
campaign_app.command("resume")(rig.resume)
campaign_app.command("list")(data.list_campaigns)
campaign_app.command("show")(data.show_campaign)
app.command("hil")(hil.hil)
app.command("reproduce")(reproduce.reproduce)
app.command("serve")(serving.serve)
app.add_typer(campaign_app, name="campaign")
app.add_typer(data.store_app, name="store")
app.add_typer(keys.app, name="keys")
app.add_typer(serving.config_app, name="config")


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"entrain {version('entrain')}")
        raise typer.Exit


@app.callback()
def options(
    config: Annotated[Path | None, typer.Option(help="Configuration file.")] = None,
    debug: Annotated[bool, typer.Option(help="Show the trace of an error.")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version.")
    ] = False,
) -> None:
    """Options of every command."""
    use_config(config)


INTERRUPTED = 130  # what typer makes of Ctrl-C, without a word


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    words = sys.argv[1:] if arguments is None else arguments
    if isinstance(sys.stdout, TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # what a terminal cannot show
    try:
        app(args=words)
    except SystemExit as ended:
        if ended.code == INTERRUPTED:
            sys.stderr.write("entrain: interrupted\n")
        raise
    except Exception as error:
        if "--debug" in words:
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            text += ": the disk is full, make room"
        prefix = "" if isinstance(error, expected()) else f"unforeseen {type(error).__name__}: "
        sys.stderr.write(f"entrain: {prefix}{text}\n")
        sys.exit(2 if isinstance(error, bad_input()) else 1)


# Errors whose message was written for the user, and what they mean. A class whose module was never
# imported cannot have been raised, so nothing is imported to tell them apart.
BAD_INPUT = (
    ("daq.errors", "InputError"),
    ("daq.errors", "UnknownItem"),
    ("daq.service.keys", "InvalidKey"),
    ("daq.service.settings", "ConfigError"),
    ("drivers.errors", "SettingError"),
    ("drivers.errors", "DeviceNotFound"),
    ("identify.declare", "ModelError"),
    ("identify.harmonics", "RecordError"),
    ("identify.load", "LoadError"),
)
FAILED = (("daq.errors", "DaqError"), ("drivers.errors", "DriverError"))


def bad_input() -> tuple[type[Exception], ...]:
    """Errors that mean: not possible as asked."""
    return _loaded(BAD_INPUT)


def expected() -> tuple[type[Exception], ...]:
    """Errors whose message was written for the user."""
    return (*bad_input(), *_loaded(FAILED), OSError)


def _loaded(names: tuple[tuple[str, str], ...]) -> tuple[type[Exception], ...]:
    return tuple(getattr(sys.modules[m], name) for m, name in names if m in sys.modules)


if __name__ == "__main__":
    main()
