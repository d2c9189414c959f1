"""A private JACK server without a card (dummy driver), and wires on it from a client to itself."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from tempfile import TemporaryFile

HOST_API = "JACK Audio Connection Kit"
RATE_HZ = 48000


@contextmanager
def jack_server(period: int = 256, lines: int = 4) -> Iterator[dict[str, str]]:
    """Run `jackd` with `lines` each way; yields the environment in which clients find it."""
    # JACK knows eight servers, and forgets one that was killed only when its name comes again.
    name = f"entrain-test-{os.getpid() % 4}"
    env = os.environ | {"JACK_NO_AUDIO_RESERVATION": "1", "JACK_NO_START_SERVER": "1"}
    env["JACK_DEFAULT_SERVER"] = name
    command = ["jackd", "-n", name, "--no-realtime", "-d", "dummy", "-r", str(RATE_HZ)]
    command += ["-p", str(period), "-C", str(lines), "-P", str(lines)]
    waiter = shutil.which("jack_wait")
    assert waiter is not None
    with TemporaryFile() as log:
        jackd = subprocess.Popen(command, env=env, stdout=log, stderr=log)
        try:
            waited = subprocess.run([waiter, "-s", name, "-w", "-t", "15"], env=env, timeout=20)
            if waited.returncode:
                log.seek(0)
                raise RuntimeError(f"jackd did not start: {log.read().decode()}")
            yield env
        finally:
            jackd.terminate()
            try:
                jackd.wait(3.0)
            except subprocess.TimeoutExpired:  # a wedged server ignores the request
                jackd.kill()
                jackd.wait()


@contextmanager
def wired_to_itself(client: str) -> Iterator[None]:
    """Each output of the client so named at its input of that number, and no other wire.

    Meanwhile the server runs free of the clock, so the samples are the same however busy the
    machine; it must not when the client closes. To be called in the server's environment.
    """
    import jack

    with jack.Client("wires", no_start_server=True) as hands:
        outs, ins = (
            hands.get_ports(f"{client}.*", is_audio=True, is_output=way, is_input=not way)
            for way in (True, False)
        )
        for port in (*outs, *ins):
            for other in hands.get_all_connections(port):
                hands.disconnect(*((port, other) if port in outs else (other, port)))
        for out, into in zip(outs, ins, strict=False):
            hands.connect(out, into)
        hands.set_freewheel(True)
        try:
            yield
        finally:
            hands.set_freewheel(False)
