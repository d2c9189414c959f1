"""An NI card behind nidaqmx's own call signatures: no card and no driver can run here.

Every call is bound to the signature of the library's method of that name, so a wrong or missing
argument fails as it would there. The card itself: 2 inputs, of which the first is wired to the
output; both run on one clock from one trigger; output that is not fed stops with DAQmx's error.
"""

import functools
import inspect
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from nidaqmx import constants
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.stream_writers import AnalogSingleChannelWriter
from nidaqmx.task import Timing
from nidaqmx.task.collections import AIChannelCollection, AOChannelCollection
from nidaqmx.task.triggering import StartTrigger

from drivers.ni_library import Library
from drivers.types import FloatArray


def like(original: Callable[..., Any]) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Call `method(self, arguments by name)` after binding them to `original`'s signature."""
    signature = inspect.signature(original)

    def wrap(method: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(method)
        def call(self: Any, *positional: Any, **named: Any) -> Any:
            bound = signature.bind(self, *positional, **named)
            bound.apply_defaults()
            _, *rest = bound.arguments.items()
            return method(self, **dict(rest))

        return call

    return wrap


def failure(code: DAQmxErrors, text: str) -> DaqError:
    return DaqError(text, code.value)


class Card:
    """What both tasks share."""

    rates = (8000.0, 16000.0, 51200.0)

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.reset()
        self.unplugged = False
        self.open_tasks: list[Task] = []

    def reset(self, held_v: float = 0.0) -> None:
        """No task; the converter holds its last value."""
        self.rest_v = held_v
        self.played: list[FloatArray] = []
        self.written = self.read = 0
        self.rate_hz = 0.0
        self.started_s: float | None = None
        self.output_armed = False
        self.slaved = self.triggered = False
        self.low, self.high = -10.0, 10.0

    def library(self) -> Library:
        return Library(
            task=lambda: Task(self),
            reader=Reader,
            writer=Writer,
            terminal=lambda name: constants.TerminalConfiguration[name],
            continuous=constants.AcquisitionType.CONTINUOUS,
            no_regeneration=constants.RegenerationMode.DONT_ALLOW_REGENERATION,
            error=DaqError,
            devices=list,
            version="emulated",
        )

    @property
    def held_v(self) -> float:
        """What the output would hold if its task ended now."""
        return float(np.concatenate(self.played)[self.read]) if self.played else self.rest_v


class Task:
    def __init__(self, card: Card) -> None:
        self.card = card
        self.kind = ""
        self.inputs: list[tuple[float, float]] = []
        self.ai_channels = _AiChannels(self)
        self.ao_channels = _AoChannels(self)
        self.timing = _Timing(self)
        self.triggers = SimpleNamespace(start_trigger=_StartTrigger(self))
        self.out_stream = SimpleNamespace(task=self, regen_mode=None)
        self.in_stream = SimpleNamespace(task=self)
        card.open_tasks.append(self)

    def start(self) -> None:
        card = self.card
        if self.kind == "ao":
            assert self.out_stream.regen_mode is (
                constants.RegenerationMode.DONT_ALLOW_REGENERATION
            )
            assert card.slaved, "the output does not run on the input's clock"
            assert card.triggered, "the output does not wait for the input's trigger"
            assert card.written > 0, "nothing to play at the trigger"
            card.output_armed = True
        else:
            assert card.output_armed, "the input started before the output was armed"
            card.started_s = time.monotonic()

    def close(self) -> None:
        self.card.open_tasks.remove(self)
        if not self.card.open_tasks:
            self.card.reset(held_v=self.card.held_v)


class _Part:
    def __init__(self, task: Task) -> None:
        self.task = task


class _AiChannels(_Part):
    @like(AIChannelCollection.add_ai_voltage_chan)
    def add_ai_voltage_chan(self, physical_channel: str, **rest: Any) -> None:
        device, _, name = physical_channel.partition("/")
        if device != "Dev1" or name not in ("ai0", "ai1"):
            raise failure(
                DAQmxErrors.PHYSICAL_CHAN_DOES_NOT_EXIST,
                f"Physical channel specified does not exist on this device.\n{physical_channel}",
            )
        assert isinstance(rest["terminal_config"], constants.TerminalConfiguration)
        self.task.kind = "ai"
        self.task.inputs.append((rest["min_val"], rest["max_val"]))


class _AoChannels(_Part):
    @like(AOChannelCollection.add_ao_voltage_chan)
    def add_ao_voltage_chan(self, physical_channel: str, **rest: Any) -> None:
        assert physical_channel == "Dev1/ao0"
        self.task.kind = "ao"
        self.task.card.low, self.task.card.high = rest["min_val"], rest["max_val"]


class _Timing(_Part):
    @like(Timing.cfg_samp_clk_timing)
    def cfg_samp_clk_timing(self, rate: float, source: str, **rest: Any) -> None:
        assert rest["sample_mode"] is constants.AcquisitionType.CONTINUOUS
        card = self.task.card
        if self.task.kind == "ai":
            # Coerced upwards, as delta-sigma cards do.
            card.rate_hz = min((r for r in card.rates if r >= rate), default=card.rates[-1])
        else:
            assert rate == card.rate_hz
            card.slaved = source == "/Dev1/ai/SampleClock"

    @property
    def samp_clk_rate(self) -> float:
        return self.task.card.rate_hz


class _StartTrigger(_Part):
    @like(StartTrigger.cfg_dig_edge_start_trig)
    def cfg_dig_edge_start_trig(self, trigger_source: str, trigger_edge: Any) -> None:
        self.task.card.triggered = trigger_source == "/Dev1/ai/StartTrigger"


class Reader:
    def __init__(self, task_in_stream: Any) -> None:
        self.task: Task = task_in_stream.task

    @like(AnalogMultiChannelReader.read_many_sample)
    def read_many_sample(
        self, data: FloatArray, number_of_samples_per_channel: int, timeout: float
    ) -> int:
        card = self.task.card
        frames = number_of_samples_per_channel
        assert data.shape == (len(self.task.inputs), frames)
        assert data.dtype == np.float64
        assert card.started_s is not None
        due_s = card.started_s + (card.read + frames) / card.rate_hz
        time.sleep(max(0.0, due_s - time.monotonic()))
        if card.unplugged:
            raise failure(
                DAQmxErrors.DEV_CANNOT_BE_ACCESSED, "Device cannot be accessed.\nmore text"
            )
        with card.lock:
            played = np.concatenate(card.played)[card.read : card.read + frames]
            if played.size < frames:
                raise failure(
                    DAQmxErrors.GEN_STOPPED_TO_PREVENT_REGEN_OF_OLD_SAMPLES,
                    "The generation has stopped to prevent the regeneration of old samples.",
                )
        for row, (low, high) in enumerate(self.task.inputs):
            wire = played if row == 0 else np.zeros(frames)
            data[row] = np.clip(wire, low, high)
        card.read += frames
        return frames


class Writer:
    def __init__(self, task_out_stream: Any) -> None:
        self.task: Task = task_out_stream.task

    @like(AnalogSingleChannelWriter.write_many_sample)
    def write_many_sample(self, data: FloatArray, timeout: float) -> int:
        card = self.task.card
        assert data.ndim == 1
        assert data.dtype == np.float64
        assert np.all((data >= card.low) & (data <= card.high))
        with card.lock:
            card.played.append(data.copy())
            card.written += data.size
        return int(data.size)
