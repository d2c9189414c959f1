"""`entrain serve`: uvicorn around the application; going down, the speaker is silenced first."""

import logging
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

import uvicorn

from daq.locks import try_lock
from daq.service.app import create_app, recover
from daq.service.settings import ConfigError, Settings
from daq.service.state import Service

log = logging.getLogger("entrain.service")


class Server(uvicorn.Server):
    """A server that on a signal silences every rig before it does anything else."""

    def __init__(self, config: uvicorn.Config, service: Service) -> None:
        super().__init__(config)
        self.service = service

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        # A thread, since the signal may have interrupted a send on the same pipe.
        threading.Thread(target=self.silence, args=(f"signal {sig}",)).start()
        super().handle_exit(sig, frame)

    def silence(self, reason: str) -> None:
        """Silence every rig and end the live streams."""
        self.service.closing = True
        self.service.control.stop(f"shutdown ({reason})")


def check(settings: Settings, service: Service) -> None:
    """Refuse to listen where anyone could move the speaker without a key."""
    active = [key for key in service.keys.all() if not key.revoked]
    if settings.needs_key and not active:
        raise ConfigError(
            f"server.host={settings.server.host!r} asks for API keys and none exists: "
            "make one with `entrain keys create NAME --scope admin`"
        )


def make_server(settings: Settings) -> Server:
    """A server, ready to run, its store in order; raises `ConfigError` where it must not listen."""
    app, service = create_app(settings)
    check(settings, service)
    recover(service)
    tls = settings.server.tls_certificate, settings.server.tls_key
    config = uvicorn.Config(
        app,
        host=settings.server.host,
        port=settings.server.port,
        http="h11",  # the one of uvicorn's two that bounds a request's head
        ssl_certfile=tls[0],
        ssl_keyfile=tls[1],
        log_config=None,
        access_log=False,  # the guard writes its own, without queries
        server_header=False,
        ws="websockets-sansio",
        ws_per_message_deflate=False,  # pictures would be deflated anew for every client
        ws_max_size=65_536,  # clients have nothing to say
        timeout_graceful_shutdown=max(1, round(settings.server.shutdown_s)),
        h11_max_incomplete_event_size=65_536,
    )
    # `access_log` takes its handlers away; one who listens to all loggers must not hear it either
    logging.getLogger("uvicorn.access").disabled = True
    return Server(config, service)


def listen(host: str, port: int) -> socket.socket:
    """A listening socket whose answers leave at once.

    Without TCP_NODELAY an answer's body waits for the client's delayed acknowledgement of its
    head, 40 ms a request; accepted sockets inherit it.

    Raises `ConfigError` where the address cannot be bound.
    """
    sock = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    try:
        sock.bind((host, port))
        sock.listen()  # whoever is told the address may connect at once
    except OSError as error:
        sock.close()
        raise ConfigError(f"server.host={host!r}, server.port={port}: {error.strerror}") from error
    return sock


@contextmanager
def alone(settings: Settings) -> Iterator[None]:
    """Hold the data directory: an emergency stop reaches only the rigs of the service asked.

    Raises `ConfigError` where another service holds it. The lock dies with the process.
    """
    place = settings.data_dir
    try:
        place.mkdir(parents=True, exist_ok=True)
        file = (place / "service.lock").open("ab")
    except OSError as error:
        raise ConfigError(
            f"data_dir={str(place)!r} cannot be written ({error.strerror})"
        ) from error
    with file:
        if not try_lock(file):
            raise ConfigError(
                f"data_dir={str(place)!r} is served by another process: "
                "stop that one, or give this one a data_dir of its own"
            )
        yield


def serve(settings: Settings, ready: Callable[[str], None] | None = None) -> None:
    """Listen until a signal; `ready` is told the address.

    Raises `ConfigError` where the address cannot be bound, or the data are another service's.
    """
    with alone(settings):
        _serve(make_server(settings), settings, ready)


def _serve(server: Server, settings: Settings, ready: Callable[[str], None] | None) -> None:
    host = settings.server.host
    sock = listen(host, settings.server.port)
    scheme = "https" if settings.server.tls_certificate else "http"
    shown = f"[{host}]" if ":" in host else host
    address = f"{scheme}://{shown}:{sock.getsockname()[1]}"
    log.info("listening on %s", address)
    if ready is not None:
        ready(address)
    with sock:
        try:
            server.run(sockets=[sock])
        finally:
            # Done already where the shutdown was orderly; else jobs would outlive the service.
            server.service.jobs.close(settings.server.shutdown_s)
