"""A real server on a real socket, for the tests of the service."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from daq.service.server import Server, listen, make_server
from daq.service.settings import Settings
from daq.service.state import Service


@dataclass
class Running:
    """A server that answers at `url`."""

    url: str
    server: Server

    @property
    def service(self) -> Service:
        return self.server.service

    def client(self, key: str | None = None, **options: Any) -> httpx.Client:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        base = f"{self.url}/api/v1"
        return httpx.Client(base_url=base, headers=headers, timeout=20, trust_env=False, **options)


@contextmanager
def running(data_dir: Path, **settings: Any) -> Iterator[Running]:
    """Serve with `settings` from a thread until the block ends."""
    server = make_server(Settings(data_dir=data_dir, **settings))
    with listen("127.0.0.1", 0) as sock:
        started = threading.Event()
        startup = server.startup

        async def announce(sockets: list[socket.socket] | None = None) -> None:
            await startup(sockets)
            started.set()

        server.startup = announce  # type: ignore[method-assign]
        thread = threading.Thread(target=server.run, kwargs={"sockets": [sock]}, daemon=True)
        thread.start()
        assert started.wait(20), "the server did not start"
        try:
            scheme = "https" if server.config.is_ssl else "http"
            yield Running(f"{scheme}://127.0.0.1:{sock.getsockname()[1]}", server)
        finally:
            server.silence("end of the test")
            server.should_exit = True
            thread.join(20)
            assert not thread.is_alive(), "the server did not stop"
