"""One VISA instrument: commands one at a time, errors in our tree, a timeout that heals itself.

After a timeout the answer may still be on its way and would be taken for the answer to the next
question. The link is therefore closed at once and opened anew before the next use.
"""

import contextlib
import threading
from typing import Any

from drivers.errors import DeviceFault, DeviceLost, DeviceTimeout, DriverError, MissingDependency

ERRORS_AT_ONCE = 20  # an instrument's queue is no longer; stops a device that always has one more


def resource_manager(backend: str = "@py") -> Any:
    """PyVISA's manager for a back end.

    ``@py`` is PyVISA-py, ``""`` a vendor's library, ``FILE@sim`` a simulation.
    """
    try:
        import pyvisa
    except ImportError as error:
        raise MissingDependency("pyvisa missing: pip install pyvisa pyvisa-py") from error
    try:
        return pyvisa.ResourceManager(backend)
    except (OSError, ValueError) as error:
        raise MissingDependency(
            f"VISA back end {backend!r} cannot be loaded ({error}): pip install pyvisa-py, "
            "or install the vendor's VISA library"
        ) from error


class VisaLink:
    """Commands and queries to `address`, for instance ``TCPIP::192.0.2.7::5025::SOCKET``.

    Raises `DeviceTimeout` when the instrument does not answer in `timeout_s`, `DeviceLost` when
    the connection broke; either way the next use opens it again.
    """

    def __init__(self, address: str, timeout_s: float = 2.0, backend: str = "@py") -> None:
        self.address = address
        self._timeout_ms = round(timeout_s * 1000)
        self._manager = resource_manager(backend)
        self._resource: Any = None
        # Reentrant, so that a setting and the reading of its errors stay together.
        self.lock = threading.RLock()

    def write(self, command: str) -> None:
        with self.lock:
            self._guarded(command, lambda resource: resource.write(command))

    def query(self, command: str) -> str:
        with self.lock:
            answer = self._guarded(command, lambda resource: resource.query(command))
            return str(answer).strip()

    def query_block(self, command: str) -> bytes:
        """The payload of an IEEE 488.2 definite-length block."""
        with self.lock:
            return bytes(
                self._guarded(
                    command,
                    lambda resource: resource.query_binary_values(
                        command, datatype="B", container=bytes
                    ),
                )
            )

    def set(self, command: str, error_query: str) -> None:
        """Write a setting and empty the error queue; `DeviceFault` quotes what it held."""
        with self.lock:
            self.write(command)
            errors = self.errors(error_query)
        if errors:
            raise DeviceFault(f"{self.address}: {command!r} was answered by {'; '.join(errors)}")

    def errors(self, error_query: str) -> list[str]:
        """Every entry of the instrument's error queue, which is empty afterwards."""
        found: list[str] = []
        while len(found) < ERRORS_AT_ONCE:
            entry = self.query(error_query)
            number = entry.split(",")[0].strip().lstrip("+-")
            if number.strip("0") == "":
                return found
            found.append(entry)
        return found

    def close(self) -> None:
        """Harmless twice; the next use would open it again."""
        with self.lock:
            resource, self._resource = self._resource, None
            if resource is not None:
                with contextlib.suppress(Exception):
                    resource.close()

    def _guarded(self, command: str, use: Any) -> Any:
        import pyvisa

        try:
            return use(self._open())
        except pyvisa.errors.VisaIOError as error:
            self._clear()
            if error.error_code == pyvisa.constants.StatusCode.error_timeout:
                raise DeviceTimeout(
                    f"{self.address}: {command!r} not answered within {self._timeout_ms} ms"
                ) from error
            raise DeviceLost(f"{self.address}: {command!r} failed: {error}") from error
        except DriverError:
            raise
        except (OSError, ValueError) as error:
            # PyVISA-py lets a socket's own errors through; a broken block is a ValueError.
            self.close()
            raise DeviceLost(f"{self.address}: {command!r} failed: {error}") from error

    def _open(self) -> Any:
        if self._resource is None:
            self._resource = self._manager.open_resource(
                self.address,
                timeout=self._timeout_ms,
                open_timeout=self._timeout_ms,
                # PyVISA reads to no termination by default, and then waits for ever.
                read_termination="\n",
                write_termination="\n",
            )
        return self._resource

    def _clear(self) -> None:
        # On GPIB and USB a device clear empties the instrument's own buffers. A bare socket has
        # no such thing: PyVISA-py reads it empty instead, for ever when the far end is gone.
        if self._resource is not None and not self.address.upper().endswith("SOCKET"):
            with contextlib.suppress(Exception):
                self._resource.clear()
        self.close()
