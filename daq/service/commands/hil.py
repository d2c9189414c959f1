"""`entrain hil`: the plant in real time, for other programs and equipment to plug into."""

import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.text import Text

from daq.service.commands.common import JsonOption, finite, out, positive, write_json

if TYPE_CHECKING:
    from simulated_rig.controllers import LinearController
    from simulated_rig.hil import AudioSettings, HilReport

WIRES = "for the other side: ALSA_CONFIG_PATH={} with device rig_daq (out) and rig_daq_in (in)"


def hil(
    preset: Annotated[str, typer.Option(help="Which tube.")] = "thesis-two-mode",
    seed: Annotated[int, typer.Option(min=0, help="Of all noise.")] = 0,
    seconds: Annotated[
        float | None, typer.Option(help="How long; else until Ctrl-C.", callback=positive)
    ] = None,
    input_: Annotated[
        str | None, typer.Option("--input", help="Sound device that carries the speaker's signal.")
    ] = None,
    output: Annotated[
        str | None, typer.Option(help="Sound device that the microphones' signals go to.")
    ] = None,
    api: Annotated[str, typer.Option(help="Host API of the sound devices.")] = "ALSA",
    latency: Annotated[
        float, typer.Option(help="Of the sound devices, in seconds.", callback=positive)
    ] = 0.05,
    sound_server: Annotated[
        bool, typer.Option(help="Without a sound card: start a private sound server for both.")
    ] = False,
    instruments: Annotated[
        bool, typer.Option(help="SCPI generator and serial amplifier beside the sound devices too.")
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="The generator's TCP port; 0 takes any.")
    ] = 0,
    controller: Annotated[
        str | None, typer.Option(help="MODULE:FUNCTION, pressures (Pa) to volts, in the loop.")
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(
            help="Or the phase shifter of Fig. 1.4 with this gain (V/Pa).", callback=finite
        ),
    ] = None,
    phase_deg: Annotated[
        float, typer.Option(help="Phase of the phase shifter.", callback=finite)
    ] = 285.0,
    json_: JsonOption = None,
) -> None:
    """Run the plant in real time, behind sound devices or a serial board, until Ctrl-C.

    Without --input and --output (or --sound-server) a serial board paces the plant, with generator
    and amplifier. The report says deadlines missed, xruns, frames lost; a fault ends it with 1.
    """
    from daq.errors import InputError
    from simulated_rig.build import build_config
    from simulated_rig.hil import AmplifierSettings, HilSettings, run

    if (input_ is None) != (output is None):
        raise InputError("--input and --output go together: name both sound devices")
    with contextlib.ExitStack() as stack:
        audio = _audio(stack, input_, output, api, latency, sound_server)
        instruments = instruments or audio is None
        rate_hz = HilSettings(audio=audio).rate_hz
        try:
            config = build_config(preset)
            law = _controller(controller, gain, phase_deg, rate_hz, len(config.microphones))
        except ValueError as error:
            raise InputError(str(error)) from error
        settings = HilSettings(
            config,
            audio,
            generator_port=port if instruments else None,
            amplifier=AmplifierSettings() if instruments else None,
            controller=law,
            seed=seed,
        )
        stop = stack.enter_context(_told())
        show = stack.enter_context(_view(quiet=str(json_) == "-"))
        report = run(settings, seconds, show, stop)
    write_json(json_, asdict(report))
    if str(json_) != "-":
        out.print("\n".join(report.lines()), markup=False)
    if report.fault is not None:
        raise typer.Exit(1)


def _audio(
    stack: contextlib.ExitStack,
    input_: str | None,
    output: str | None,
    api: str,
    latency_s: float,
    sound_server: bool,
) -> "AudioSettings | None":
    """The sound devices that were asked for, the private server's where there shall be one."""
    from dataclasses import replace

    from simulated_rig.hil import AudioSettings

    if sound_server:
        from simulated_rig.hil.sound_server import SoundServer

        server = stack.enter_context(SoundServer())
        typer.echo(WIRES.format(server.asound), err=True)
        return replace(server.plant, latency_s=latency_s)
    if input_ is None or output is None:
        return None
    return AudioSettings(input_, output, api, latency_s=latency_s)


def _controller(
    named: str | None, gain: float | None, phase_deg: float, rate_hz: float, microphones: int
) -> "LinearController | Any":
    """The user's own function, or the phase shifter, or none; raises `ValueError`."""
    if named is None and gain is None:
        return None
    if named is None:
        from math import radians

        from simulated_rig.controllers import PhaseShifter

        shifter = PhaseShifter(phase_rad=radians(phase_deg), gain_v_per_pa=gain or 0.0)
        return shifter.linear(rate_hz, microphones)
    module, _, name = named.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError) as error:
        raise ValueError(f"--controller={named!r} is not MODULE:FUNCTION: {error}") from error


@contextlib.contextmanager
def _told() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set."""
    stop = threading.Event()
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in numbers]
    try:
        yield stop
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@contextlib.contextmanager
def _view(quiet: bool) -> Iterator[Any]:
    """`on_report`: redrawn every second on a terminal, elsewhere once, with the addresses."""
    if quiet:
        yield None
        return
    if not out.is_terminal:
        told: list[int] = []

        def once(report: "HilReport") -> None:
            if not told:
                told.append(1)
                print("\n".join(report.lines()), flush=True)

        yield once
        return
    with Live(console=out, transient=True) as live:
        yield lambda report: live.update(Text("\n".join(report.lines())))
