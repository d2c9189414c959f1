"""`entrain serve` and `entrain config`."""

import json
from typing import Annotated, Any

import typer

from daq.service.commands.common import config_file, out, table

config_app = typer.Typer(help="The configuration in force.", no_args_is_help=True)


def serve(
    host: Annotated[str | None, typer.Option(help="Address to bind.")] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port; 0 takes any.")] = None,
) -> None:
    """Serve the REST API and the page until Ctrl-C."""
    from daq.service import logs, server
    from daq.service.settings import load

    given: dict[str, Any] = {"server__host": host, "server__port": port}
    chosen = {key: value for key, value in given.items() if value is not None}
    settings = load(config_file(), **chosen)
    logs.configure(settings.log.level, settings.log.format)

    def ready(address: str) -> None:
        typer.echo(f"entrain listens on {address}  (Ctrl-C silences the rigs and ends)")

    server.serve(settings, ready)


@config_app.command("show")
def show(
    json_: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Every setting: its value, where it comes from, what it means."""
    from daq.service.settings import explain

    origins = explain(config_file())
    if json_:
        rows = {o.key: {"value": o.value, "source": o.source} for o in origins}
        typer.echo(json.dumps(rows, indent=1, default=str))
        return
    table(
        "",
        ("setting", "value", "from", "meaning"),
        ((o.key, o.value, o.source, o.description) for o in origins),
    )
    out.print("environment: ENTRAIN_SERVER__PORT=9000 sets server.port; file: [server] port = 9000")
