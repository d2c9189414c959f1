"""SCPI signal generators as speaker outputs, in the makers' dialects."""

from dataclasses import replace

from drivers.errors import DeviceFault, DriverError, SettingError
from drivers.scpi_dialects import Dialect, dialect_for
from drivers.stepped_output import SteppedOutput
from drivers.types import OutputLimits
from drivers.visa_link import VisaLink


class ScpiGenerator:
    """One output of a generator, as a `ToneDevice`; opened silent, as a sine without offset.

    Each setting is followed by the reading of the error queue and of the setting itself.
    """

    def __init__(self, link: VisaLink, output: int = 1, dialect: Dialect | None = None) -> None:
        self.link = link
        self.identity = link.query("*IDN?")
        self.dialect = dialect or dialect_for(self.identity)
        self._n = output
        self._on = True
        link.errors(self.dialect.error_query)  # what earlier users left
        self._switch(on=False)
        for command in self.dialect.prepare:
            self._set(command)
        self._frequencies = self._range(
            self.dialect.frequency_range, self.dialect.frequency_pattern
        )
        self._amplitudes = self._range(self.dialect.amplitude_range, self.dialect.amplitude_pattern)
        self._least_v = 0.0 if self._amplitudes is None else self._amplitudes[0] / 2.0

    def within(self, limits: OutputLimits) -> OutputLimits:
        """`limits`, narrowed to what the instrument itself says that it can do."""
        if self._frequencies is not None:
            limits = replace(
                limits,
                min_frequency_hz=max(limits.min_frequency_hz, self._frequencies[0]),
                max_frequency_hz=min(limits.max_frequency_hz, self._frequencies[1]),
            )
        if self._amplitudes is not None:
            peak = self._amplitudes[1] / 2.0
            limits = replace(limits, max_amplitude_v=min(limits.max_amplitude_v, peak))
        return limits

    def set_frequency(self, frequency_hz: float) -> float:
        dialect = self.dialect
        try:
            self._set(dialect.set_frequency, frequency_hz)
        except DeviceFault as error:
            raise SettingError(f"frequency_hz={frequency_hz} is not accepted: {error}") from error
        return self._get(dialect.get_frequency, dialect.frequency_pattern)

    def set_amplitude(self, amplitude_v: float) -> float:
        dialect = self.dialect
        if amplitude_v <= 0.0 or amplitude_v < self._least_v:
            # Off alone: generators refuse amplitudes below their least, zero among them.
            self._switch(on=False)
            return 0.0
        self._set(dialect.set_amplitude, 2.0 * amplitude_v)
        reached = self._get(dialect.get_amplitude, dialect.amplitude_pattern) / 2.0
        if not self._on:
            self._switch(on=True)
        return reached

    def close(self) -> None:
        self.link.close()

    def _switch(self, *, on: bool) -> None:
        """On or off, and seen to be: an instrument may lose a command and report no error."""
        dialect = self.dialect
        self._set(dialect.output_on if on else dialect.output_off)
        question = dialect.get_output.format(n=self._n)
        answer = self.link.query(question)
        try:
            is_on = dialect.is_on(answer)
        except ValueError as error:
            raise DeviceFault(f"{self.link.address}: {question!r}: {error}") from error
        if is_on != on:
            raise DeviceFault(
                f"{self.link.address}: told to switch its output {'on' if on else 'off'}, "
                f"the generator answers {answer!r} to {question!r}"
            )
        self._on = on

    def _set(self, template: str, value: float | None = None) -> None:
        # µHz and µV; always with a point, which every parser takes for a number.
        text = "" if value is None else f"{value:.6f}"
        self.link.set(template.format(n=self._n, x=text), self.dialect.error_query)

    def _get(self, template: str, pattern: str) -> float:
        answer = self.link.query(template.format(n=self._n))
        try:
            return self.dialect.number(pattern, answer)
        except ValueError as error:
            raise DeviceFault(
                f"{self.link.address}: {template!r} was answered {answer!r}"
            ) from error

    def _range(self, queries: tuple[str, str] | None, pattern: str) -> tuple[float, float] | None:
        if queries is None:
            return None
        return self._get(queries[0], pattern), self._get(queries[1], pattern)


def open_generator(
    address: str,
    limits: OutputLimits,
    *,
    output: int = 1,
    dialect: Dialect | None = None,
    timeout_s: float = 2.0,
    backend: str = "@py",
) -> SteppedOutput:
    """A generator's output, silent, with `limits` narrowed to what the instrument allows.

    The dialect is chosen by ``*IDN?`` when not given. Raises `DeviceLost` or `DeviceTimeout` when
    nobody answers at `address`.
    """
    link = VisaLink(address, timeout_s, backend)
    try:
        generator = ScpiGenerator(link, output, dialect)
        return SteppedOutput(generator, generator.within(limits))
    except DriverError:
        link.close()
        raise
