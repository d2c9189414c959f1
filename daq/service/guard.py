"""What every request passes before a route sees it, outermost first.

1. a request number, security headers, one log line without query, header or body;
2. the `Host` is one by which this service is known (else a foreign page could rebind a name to
   the loopback address), and whatever changes something does not come from a foreign origin;
3. who asks: an API key, or nobody;
4. how often: a token bucket for each client; the emergency stop never waits for one;
5. how much: bodies are counted while they arrive;
6. whether it was asked before: an `Idempotency-Key` replays the first answer.

Plain ASGI, so that streams stay streams. Lifespan events pass untouched.
"""

import asyncio
import hashlib
import logging
import secrets
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from daq.service.keys import LOCAL, NOBODY, KeyStore, Principal
from daq.service.metrics import Metrics
from daq.service.problems import Problem
from daq.service.settings import LOOPBACK, Settings

access = logging.getLogger("entrain.access")

BODY_S = 30.0
SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; img-src 'self' data:; style-src 'self' 'unsafe-inline'; "
        "object-src 'none'; base-uri 'none'; frame-ancestors 'none'; form-action 'self'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "X-Frame-Options": "DENY",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class Buckets:
    """Token buckets by client, the longest unused forgotten first."""

    def __init__(
        self,
        per_s: float,
        burst: int,
        clock: Callable[[], float] = time.monotonic,
        most: int = 10_000,
    ) -> None:
        self._per_s, self._burst, self._clock, self._most = per_s, burst, clock, most
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, client: str) -> float:
        """0 where a token was there, else the seconds until the next one."""
        now = self._clock()
        level, then = self._levels.pop(client, (float(self._burst), now))
        level = min(self._burst, level + (now - then) * self._per_s)
        wait = 0.0 if level >= 1 else (1 - level) / self._per_s
        self._levels[client] = (level - 1 if level >= 1 else level, now)
        if len(self._levels) > self._most:
            self._levels.popitem(last=False)
        return wait


class Tickets:
    """One-time passes for live streams, which browsers cannot send headers with."""

    def __init__(self, clock: Callable[[], float] = time.monotonic, valid_s: float = 30.0) -> None:
        self._clock, self._valid_s = clock, valid_s
        self._open: OrderedDict[str, tuple[float, Principal]] = OrderedDict()

    def issue(self, principal: Principal) -> str:
        text = secrets.token_urlsafe(24)
        self._open[text] = (self._clock() + self._valid_s, principal)
        while len(self._open) > 10_000:
            self._open.popitem(last=False)
        return text

    def redeem(self, text: str) -> Principal | None:
        until, principal = self._open.pop(text, (0.0, NOBODY))
        return principal if self._clock() < until else None


@dataclass
class _Replay:
    """An answer under an idempotency key; `status` 0 while it is still being made."""

    fingerprint: str
    status: int = 0
    headers: tuple[tuple[bytes, bytes], ...] = ()
    body: bytes = b""


def is_stop(path: str) -> bool:
    """Whether `path` is an emergency stop."""
    return path.startswith("/api/") and path.endswith("/emergency-stop")


def origin_ok(headers: Headers, settings: Settings) -> bool:
    """Whether a browser page of a foreign origin is *not* behind the request."""
    origin = headers.get("origin")
    if origin is None:
        return headers.get("sec-fetch-site", "none") in {"none", "same-origin"}
    if origin in settings.server.allowed_origins:
        return True
    return origin != "null" and urlsplit(origin).netloc == headers.get("host")


def host_ok(headers: Headers, settings: Settings) -> bool:
    """Whether the `Host` is a name of this service; a keyless service is strict about it."""
    try:
        name = urlsplit(f"//{headers.get('host', '')}").hostname or ""
    except ValueError:
        return False
    if name in settings.server.allowed_hosts or name in LOOPBACK or name == settings.server.host:
        return True
    return settings.needs_key and not settings.server.allowed_hosts


class Guard:
    """The ASGI wrapper around the application."""

    def __init__(
        self,
        app: ASGIApp,
        settings: Settings,
        keys: KeyStore,
        tickets: Tickets,
        metrics: Metrics,
    ) -> None:
        self._app = app
        self._settings = settings
        self._keys = keys
        self._tickets = tickets
        self._metrics = metrics
        self._buckets = Buckets(settings.server.requests_per_s, settings.server.request_burst)
        self._replays: OrderedDict[str, _Replay] = OrderedDict()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        number = secrets.token_hex(6)
        started = time.perf_counter()
        status = 0

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers["X-Request-ID"] = number
                for name, value in SECURITY_HEADERS.items():
                    headers.setdefault(name, value)
                if scope["path"].startswith("/api/"):
                    headers.setdefault("Cache-Control", "no-store")
            await send(message)

        state = scope.setdefault("state", {})
        state["request_id"] = number
        state["principal"] = NOBODY
        try:
            self._admit(scope)
            await self._pass(scope, receive, answer)
        except Problem as problem:
            await self._refuse(problem, number, scope, receive, answer)
        except Exception:
            # Where the application has answered with its 500 already, it logged the trace too.
            if status == 0:
                access.exception("request %s failed", number)
                await self._refuse(
                    Problem(500, "internal", "an unforeseen error"), number, scope, receive, answer
                )
        finally:
            seconds = time.perf_counter() - started
            if scope["type"] == "http":
                route = getattr(scope.get("route"), "path", "unmatched")
                self._metrics.request(scope["method"], route, status, seconds)
                who = state["principal"].name
                access.info(
                    "%s %s %s %d %.1f ms %s",
                    number,
                    scope["method"],
                    _printable(scope["path"]),
                    status,
                    1e3 * seconds,
                    who,
                )

    def _admit(self, scope: Scope) -> None:
        headers = Headers(scope=scope)
        if not host_ok(headers, self._settings):
            raise Problem(
                400,
                "host",
                "the Host header is no name of this service: add it to server.allowed_hosts",
            )
        changes = scope["type"] == "websocket" or scope["method"] not in SAFE
        if changes and not origin_ok(headers, self._settings):
            raise Problem(
                403,
                "origin",
                "the request comes from a page of another origin: "
                "add that origin to server.allowed_origins if it is meant to",
            )
        principal = self._who(scope, headers)
        scope["state"]["principal"] = principal
        if is_stop(scope["path"]):
            return
        address = scope.get("client")
        client = principal.key_id or (address[0] if address else "unknown")
        if (wait := self._buckets.take(client)) > 0:
            rate = self._settings.server.requests_per_s
            raise Problem(
                429,
                "rate",
                f"more than server.requests_per_s={rate:g} requests: wait {wait:.2f} s",
                headers={"Retry-After": str(max(1, round(wait)))},
            )

    def _who(self, scope: Scope, headers: Headers) -> Principal:
        text = headers.get("x-api-key")
        kind, _, bearer = headers.get("authorization", "").partition(" ")
        if text is None and kind.lower() == "bearer":
            text = bearer.strip()
        if text:
            principal = self._keys.authenticate(text)
            if principal is None:
                raise Problem(
                    401,
                    "key",
                    "the API key is unknown, expired or revoked: `entrain keys create` makes one",
                    headers={"WWW-Authenticate": "Bearer"},
                )
            return principal
        query = scope.get("query_string", b"").decode("latin-1")
        for part in query.split("&"):
            if part.startswith("ticket=") and (found := self._tickets.redeem(part[7:])):
                return found
        return NOBODY if self._settings.needs_key else LOCAL

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await self._app(scope, receive, send)
            return
        headers = Headers(scope=scope)
        server = self._settings.server
        upload = scope["path"].endswith(("/imports", "/characterisations"))
        limit = server.max_upload_bytes if upload else server.max_body_bytes
        try:
            declared = int(headers.get("content-length", "0"))
        except ValueError:
            raise Problem(400, "length", "Content-Length is not a number") from None
        too_large = Problem(
            413,
            "too-large",
            f"the body is larger than {limit} bytes",
            headers={"Connection": "close"},
        )
        if declared > limit:
            raise too_large
        taken = 0

        async def counted() -> Message:
            nonlocal taken
            message = await receive()
            if message["type"] == "http.request":
                taken += len(message.get("body", b""))
                if taken > limit:
                    raise too_large
            return message

        if upload or scope["method"] in SAFE:
            await self._app(scope, counted, send)
            return
        body = await _whole(counted)
        key = headers.get("idempotency-key")
        if key and scope["method"] == "POST" and not is_stop(scope["path"]):
            await self._once(key, body, scope, receive, send)
        else:
            await self._app(scope, _replaying(body, receive), send)

    async def _once(
        self, key: str, body: bytes, scope: Scope, receive: Receive, send: Send
    ) -> None:
        if len(key) > 200:
            raise Problem(422, "idempotency", "Idempotency-Key is longer than 200 characters")
        principal = scope["state"]["principal"]
        name = "\n".join((principal.key_id or principal.name, scope["path"], key))
        fingerprint = hashlib.sha256(scope["query_string"] + b"\n" + body).hexdigest()
        known = self._replays.get(name)
        if known is not None:
            if known.fingerprint != fingerprint:
                raise Problem(
                    422, "idempotency", "this Idempotency-Key came with another body before"
                )
            if known.status == 0:
                raise Problem(
                    409, "idempotency", "the first request of this Idempotency-Key runs yet"
                )
            headers = [*known.headers, (b"idempotency-replayed", b"true")]
            start = {"type": "http.response.start", "status": known.status, "headers": headers}
            await send(start)
            await send({"type": "http.response.body", "body": known.body})
            return
        replay = self._replays[name] = _Replay(fingerprint)
        while len(self._replays) > 2_000:
            self._replays.popitem(last=False)
        status = 0

        async def kept(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                replay.headers = tuple(message.get("headers", ()))
            elif message["type"] == "http.response.body":
                replay.body += message.get("body", b"")
            await send(message)

        try:
            await self._app(scope, _replaying(body, receive), kept)
        finally:
            replay.status = status
            if not 200 <= status < 300:  # a refusal changes nothing and may be tried again
                self._replays.pop(name, None)

    @staticmethod
    async def _refuse(
        problem: Problem, number: str, scope: Scope, receive: Receive, send: Send
    ) -> None:
        if scope["type"] == "websocket":
            await receive()  # the handshake; closing before it is accepted answers 403
            await send({"type": "websocket.close", "code": 1008, "reason": problem.detail[:120]})
            return
        await problem.response(number)(scope, receive, send)


async def _whole(receive: Receive) -> bytes:
    """The body, which must arrive within `BODY_S`: a trickle holds no connection for ever."""
    chunks = []
    try:
        async with asyncio.timeout(BODY_S):
            while True:
                message = await receive()
                chunks.append(message.get("body", b""))
                if message["type"] != "http.request" or not message.get("more_body"):
                    return b"".join(chunks)
    except TimeoutError:
        raise Problem(408, "slow", f"the body took longer than {BODY_S:g} s") from None


def _replaying(body: bytes, receive: Receive) -> Receive:
    sent = False

    async def again() -> Message:
        nonlocal sent
        if sent:
            return await receive()
        sent = True
        return {"type": "http.request", "body": body, "more_body": False}

    return again


def _printable(path: str) -> str:
    """`path` fit for a log line: no control characters, not endless."""
    return "".join(c if c.isprintable() else "?" for c in path[:200])


def require(principal: Principal, scope: Any) -> None:
    """Raise the right refusal unless `principal` has `scope`."""
    if principal.may(scope):
        return
    if not principal.scopes:
        raise Problem(
            401,
            "key-needed",
            "an API key is needed: send it as 'Authorization: Bearer ...'",
            headers={"WWW-Authenticate": "Bearer"},
        )
    raise Problem(403, "scope", f"this needs a key of scope {scope!r}")
