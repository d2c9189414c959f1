"""Where instruments are reached: a TCP port for SCPI, a serial terminal for lines and packets.

Both serve from a thread of their own. TCP: one listener on loopback, many connections, one
message a line. Terminal: a pseudo-terminal pair (POSIX only), whose near end's name is what a
program opens; the far end is ours. Our copy of the near end stays open, or a program that closes
its own would end the line.
"""

import asyncio
import contextlib
import os
import select
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

from drivers.errors import DriverError, MissingDependency
from simulated_rig.hil.scpi import LONGEST, Instrument, ScpiError

LONGEST_LINE = 256
POLL_S = 0.05


class ScpiServer:
    """Serves `instrument` on ``host:port``; port 0 takes a free one, see `port`."""

    def __init__(self, instrument: Instrument, port: int = 0, host: str = "127.0.0.1") -> None:
        self.instrument = instrument
        self.host, self.port = host, port
        self.connections = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended: asyncio.Event | None = None
        self._ready = threading.Event()
        self._failed: OSError | None = None
        self._thread = threading.Thread(target=self._serve, name="HIL SCPI", daemon=True)

    @property
    def address(self) -> str:
        """As VISA names it."""
        return f"TCPIP::{self.host}::{self.port}::SOCKET"

    def __enter__(self) -> Self:
        self._thread.start()
        self._ready.wait(5.0)
        if self._failed is not None:
            raise DriverError(
                f"port={self.port} on {self.host} cannot be listened on: {self._failed}"
            ) from self._failed
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._loop is not None and self._ended is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended already
                self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(5.0)

    def _serve(self) -> None:
        asyncio.run(self._main())

    async def _main(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        try:
            server = await asyncio.start_server(self._talk, self.host, self.port, limit=4 * LONGEST)
        except OSError as error:
            self._failed = error
            self._ready.set()
            return
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        await self._ended.wait()
        server.close()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.connections += 1
        try:
            while line := await self._line(reader):
                answer = self.instrument.message(line.rstrip(b"\r\n"))
                if answer is not None:
                    writer.write(answer.encode("ascii") + b"\n")
                    await writer.drain()
        except ConnectionError:
            pass
        finally:
            writer.close()

    async def _line(self, reader: asyncio.StreamReader) -> bytes:
        """The next line with its end; what overruns the buffer is thrown away up to there."""
        overrun = False
        while True:
            try:
                line = await reader.readuntil(b"\n")
            except asyncio.IncompleteReadError:
                return b""
            except asyncio.LimitOverrunError as error:
                await reader.readexactly(max(1, error.consumed))
                overrun = True
                continue
            if not overrun:
                return line
            self.instrument.refuse(ScpiError(-363))
            overrun = False


class Terminal:
    """`received` is called with what came; `send` writes, at most waiting `POLL_S`."""

    def __init__(self, received: Callable[[bytes], None]) -> None:
        try:
            import pty
            import tty
        except ImportError as error:
            raise MissingDependency(
                "serial terminal pairs need a POSIX system: here, use the TCP and audio sides"
            ) from error
        self._far, self._near = pty.openpty()
        tty.setraw(self._far)
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.name = os.ttyname(self._near)
        self._received = received
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="HIL terminal", daemon=True)

    def send(self, data: bytes) -> bool:
        """False when nobody reads and the line is full: then `data` is lost, in part or whole."""
        while data:
            if self._ended.is_set() or not select.select([], [self._far], [], POLL_S)[1]:
                return False
            with contextlib.suppress(BlockingIOError):
                data = data[os.write(self._far, data) :]
        return True

    def _run(self) -> None:
        while not self._ended.is_set():
            if select.select([self._far], [], [], POLL_S)[0]:
                self._received(os.read(self._far, 4096))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._ended.set()
        self._thread.join(5.0)
        os.close(self._near)
        os.close(self._far)


class LineTerminal(Terminal):
    """A terminal that answers each line by `answer`."""

    def __init__(self, answer: Callable[[str], str]) -> None:
        super().__init__(self._take)
        self._answer = answer
        self._rest = b""

    def _take(self, data: bytes) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        if len(self._rest) > LONGEST_LINE:
            self._rest = b""
            self.send(b"ERR line too long\n")
        for line in lines:
            self.send(
                self._answer(line.decode("ascii", "replace")).encode("ascii", "replace") + b"\n"
            )
