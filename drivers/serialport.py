"""One serial port: bytes and lines, with every way in which a port dies in our own error tree.

A port that is unplugged raises `SerialException` from a read, a bare `OSError` from a look at the
buffer and `termios.error` from a flush; here all of them are `DeviceLost`, and the port is closed.
The next use opens it again, which finds a device that was plugged back in.
"""

import contextlib
import threading
import time
from typing import Any

from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, MissingDependency

LONGEST_LINE = 4096


def pyserial() -> Any:
    """The serial module, or `MissingDependency`."""
    try:
        import serial
    except ImportError as error:
        raise MissingDependency("pyserial missing: pip install pyserial") from error
    return serial


class SerialPort:
    """`address` is a device name (``/dev/ttyUSB0``, ``COM3``) or a pySerial URL."""

    def __init__(self, address: str, baud: int = 115200, timeout_s: float = 1.0) -> None:
        self.address = address
        self._baud = baud
        self._timeout_s = timeout_s
        self._serial = pyserial()
        self._dying = dying(self._serial)
        self._port: Any = None
        self.lock = threading.RLock()

    def write(self, data: bytes) -> None:
        with self.lock:
            self._guarded(lambda port: port.write(data))

    def read(self, timeout_s: float) -> bytes:
        """What is there, at least one byte unless `timeout_s` passes; empty then."""

        def use(port: Any) -> bytes:
            port.timeout = timeout_s
            first = bytes(port.read(1))
            waiting = port.in_waiting if first else 0
            return first + (bytes(port.read(waiting)) if waiting else b"")

        return bytes(self._guarded(use))

    def ask(self, line: str, end: bytes = b"\n") -> str:
        """Send a line, return the next; a late answer to an earlier question is thrown away first.

        Raises `DeviceTimeout` without an answer in time, `DeviceFault` for one without end.
        """
        with self.lock:
            self._guarded(lambda port: port.reset_input_buffer())
            self.write(line.encode("ascii") + end)
            answer = b""
            deadline = time.monotonic() + self._timeout_s
            while end not in answer:
                answer += self.read(max(0.0, deadline - time.monotonic()))
                if len(answer) > LONGEST_LINE:
                    self.close()
                    raise DeviceFault(f"{self.address}: {line!r} was answered without end")
                if end not in answer and time.monotonic() >= deadline:
                    raise DeviceTimeout(
                        f"{self.address}: {line!r} not answered within {self._timeout_s} s"
                    )
            return answer.partition(end)[0].decode("ascii", "replace").strip()

    def open(self) -> None:
        """Open now rather than at first use; `DeviceLost` when it is not there."""
        self._guarded(lambda port: None)

    def close(self) -> None:
        """Harmless twice."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(Exception):
                port.close()

    def _guarded(self, use: Any) -> Any:
        try:
            if self._port is None:
                self._port = self._serial.serial_for_url(
                    self.address,
                    self._baud,
                    timeout=self._timeout_s,
                    write_timeout=self._timeout_s,
                )
            return use(self._port)
        except self._serial.SerialTimeoutException as error:
            raise DeviceTimeout(f"{self.address}: cannot be written to: {error}") from error
        except self._dying as error:
            self.close()
            raise DeviceLost(f"{self.address}: device lost: {error}") from error


def dying(serial: Any) -> tuple[type[BaseException], ...]:
    """What a port raises that is no longer there.

    A TypeError among them: pySerial reads from a descriptor that another thread has closed. On
    POSIX `termios.error` is raised by a flush, and is no OSError; elsewhere there is no termios.
    """
    found: tuple[type[BaseException], ...] = (serial.SerialException, OSError, TypeError)
    with contextlib.suppress(ImportError):
        import termios

        found = (*found, termios.error)
    return found
