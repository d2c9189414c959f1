"""The half of SCPI-99 and IEEE 488.2 that every instrument shares: headers, parameters, errors.

A message is commands between semicolons. A header's words have a short and a long form
(``FREQuency``), numbers at the end are suffixes, words in brackets may be left out; after a
semicolon a header goes on from where the last one stood, unless a colon leads it. An instrument
never answers a mistake: it puts it into a queue that ``SYSTem:ERRor?`` empties one by one, and
into the standard event register. Nothing here knows what the commands do.
"""

import re
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

QUEUE = 16
LONGEST = 1024  # bytes of input buffer
NO_ERROR = '0,"No error"'
# Standard event status bits (IEEE 488.2, 11.5.1) by the class of the error's number.
OPERATION, QUERY, DEVICE, EXECUTION, COMMAND, POWER_ON = 1, 4, 8, 16, 32, 128
TEXT = {
    -101: "Invalid character",
    -102: "Syntax error",
    -104: "Data type error",
    -108: "Parameter not allowed",
    -109: "Missing parameter",
    -113: "Undefined header",
    -131: "Invalid suffix",
    -200: "Execution error",
    -221: "Settings conflict",
    -222: "Data out of range",
    -224: "Illegal parameter value",
    -240: "Hardware error",
    -350: "Queue overflow",
    -363: "Input buffer overrun",
}


class ScpiError(Exception):
    """A refusal: number and, behind a semicolon, what exactly."""

    def __init__(self, number: int, detail: str = "") -> None:
        self.number = number
        text = TEXT[number] + (f"; {detail}" if detail else "")
        super().__init__(f'{number},"{text}"')


@dataclass(frozen=True)
class Number:
    """A numeric parameter: `units` maps suffixes to factors, the first is the base unit's."""

    least: float
    most: float
    units: Mapping[str, float]

    def parsed(self, text: str) -> float:
        """MIN and MAX, or a number with a suffix; raises `ScpiError`."""
        word = text.strip().upper()
        if word in ("MIN", "MINIMUM"):
            return self.least
        if word in ("MAX", "MAXIMUM"):
            return self.most
        found = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?)\s*([A-Z]*)", word)
        if found is None:
            raise ScpiError(-104, text)
        suffix = found.group(2)
        if suffix and suffix not in self.units:
            raise ScpiError(-131, suffix)
        value = float(found.group(1)) * self.units.get(suffix, 1.0)
        if not self.least <= value <= self.most:
            raise ScpiError(-222, f"{value:g} is not within {self.least:g}...{self.most:g}")
        return value


def boolean(text: str) -> bool:
    """ON, OFF, 1, 0; raises `ScpiError`."""
    word = text.strip().upper()
    if word in ("ON", "1"):
        return True
    if word in ("OFF", "0"):
        return False
    raise ScpiError(-224, text)


Handler = Callable[[str, bool], str | None]


def pattern(header: str) -> re.Pattern[str]:
    """``[SOURce[1]:]FREQuency`` as a regular expression of everything that it allows."""
    out = ""
    for token in re.findall(r"\[\d\]|\[[^\[\]]*(?:\[\d\])?:?\]|:|\*?[A-Za-z]+", header):
        if re.fullmatch(r"\[\d\]", token):
            out += f"{token[1]}?"
        elif token.startswith("["):
            out += f"(?:{pattern(token[1:-1]).pattern})?"
        elif token == ":":
            out += ":"
        else:
            short = re.match(r"\*?[A-Z]+", token)
            assert short is not None, header
            rest = token[short.end() :].upper()
            out += re.escape(short.group()) + (f"(?:{rest})?" if rest else "")
    return re.compile(out)


class Instrument:
    """Error queue, status registers and the dispatch; makers add handlers to `commands`.

    A handler is called as ``handler(parameters, query)`` and returns an answer or None.
    """

    identity = "entrain,instrument,0,0"

    def __init__(self) -> None:
        self._queue: deque[str] = deque()
        self._events = POWER_ON
        self._enabled = self._service = 0
        self.commands: list[tuple[re.Pattern[str], Handler, str]] = []
        for header, act, kind in (
            ("*IDN", lambda _p, _q: self.identity, "?"),
            ("*RST", lambda _p, _q: self.reset(), "!"),
            ("*CLS", lambda _p, _q: self._clear(), "!"),
            ("*OPC", self._operation_complete, "?!"),
            ("*WAI", lambda _p, _q: None, "!"),
            ("*TST", lambda _p, _q: "0", "?"),
            ("*ESR", lambda _p, _q: self._read_events(), "?"),
            ("*ESE", self._event_enable, "?!"),
            ("*SRE", self._service_enable, "?!"),
            ("*STB", lambda _p, _q: str(self.status_byte), "?"),
            ("SYSTem:ERRor[:NEXT]", lambda _p, _q: self._next_error(), "?"),
            ("SYSTem:VERSion", lambda _p, _q: "1999.0", "?"),
        ):
            self.add(header, act, kind)

    def add(self, header: str, handler: Handler, kind: str = "?!") -> None:
        """`kind` says whether it may be a query (?) or a command (!)."""
        self.commands.append((pattern(header), handler, kind))

    def reset(self) -> None:
        """*RST."""

    @property
    def status_byte(self) -> int:
        byte = 4 * bool(self._queue) + 32 * bool(self._events & self._enabled)
        return byte + 64 * bool(byte & self._service)

    def refuse(self, error: ScpiError) -> None:
        """Into the queue; the last place of a full one says that there were more."""
        group = -error.number // 100
        self._events |= {1: COMMAND, 2: EXECUTION, 3: DEVICE, 4: QUERY}[group]
        if len(self._queue) < QUEUE:
            self._queue.append(str(error))
        else:
            self._queue[-1] = str(ScpiError(-350))

    def message(self, line: bytes) -> str | None:
        """Carry out one line; the queries' answers between semicolons, or None without any."""
        try:
            if len(line) > LONGEST:
                raise ScpiError(-363)
            try:
                text = line.decode("ascii")
            except UnicodeDecodeError as error:
                raise ScpiError(-101) from error
            if re.search(r"[^\x20-\x7e\t\r]", text):
                raise ScpiError(-101)
        except ScpiError as error:
            self.refuse(error)
            return None
        answers, path = [], ""
        for part in text.strip().split(";"):
            command = part.strip()
            if not command:
                continue
            try:
                answer, path = self._execute(command, path)
            except ScpiError as error:
                self.refuse(error)
                # A broken command ends its message (IEEE 488.2, 6.1.7).
                if -200 < error.number <= -100:
                    break
                continue
            if answer is not None:
                answers.append(answer)
        return ";".join(answers) if answers else None

    def _execute(self, command: str, path: str) -> tuple[str | None, str]:
        found = re.fullmatch(r"(:?\*?[A-Za-z0-9:_]+)(\??)(?:\s+(.*))?", command)
        if found is None:
            raise ScpiError(-102, command)
        header, query, rest = found.group(1).upper(), bool(found.group(2)), found.group(3) or ""
        if header.startswith("*"):
            full, after = header, path
        else:
            full = header[1:] if header.startswith(":") else path + header
            after = full.rpartition(":")[0]
            after += ":" if after else ""
        for expression, handler, kind in self.commands:
            if expression.fullmatch(full):
                if ("?" if query else "!") not in kind:
                    break
                return handler(rest, query), after
        raise ScpiError(-113, command)

    def _clear(self) -> None:
        self._queue.clear()
        self._events = 0

    def _next_error(self) -> str:
        return self._queue.popleft() if self._queue else NO_ERROR

    def _read_events(self) -> str:
        events, self._events = self._events, 0
        return str(events)

    def _operation_complete(self, _parameters: str, query: bool) -> str | None:
        if query:
            return "1"
        self._events |= OPERATION
        return None

    def _event_enable(self, parameters: str, query: bool) -> str | None:
        if query:
            return str(self._enabled)
        self._enabled = int(Number(0, 255, {}).parsed(parameters))
        return None

    def _service_enable(self, parameters: str, query: bool) -> str | None:
        if query:
            return str(self._service)
        self._service = int(Number(0, 255, {}).parsed(parameters))
        return None
