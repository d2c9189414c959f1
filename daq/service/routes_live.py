"""Live streams: WebSocket and server-sent events over the one bus.

`since=N` (or `Last-Event-ID`) resumes behind event N; `kinds=a,b` filters. Over the WebSocket
events with samples come as binary frames (layout in `daq.service.events`), all others as JSON
text; over server-sent events samples are left out. Both tell of drops with an event `dropped`.
"""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from typing import Annotated

from fastapi import APIRouter, Header, Query, Request, WebSocket
from fastapi.responses import StreamingResponse
from starlette.websockets import WebSocketDisconnect

from daq.service.events import Event, Subscription
from daq.service.guard import require
from daq.service.problems import Problem
from daq.service.state import Parts, Reader, Service
from daq.service.wire import Ticket

router = APIRouter(tags=["live"])
Kinds = Annotated[str | None, Query(max_length=200, description="Comma-separated kinds")]
Since = Annotated[int | None, Query(ge=0, description="Resume behind this sequence number")]


@router.post("/live/ticket")
async def ticket(service: Parts, who: Reader) -> Ticket:
    """A one-time pass: `?ticket=...` on a live stream, where no header can be sent."""
    return Ticket(ticket=service.tickets.issue(who), expires_s=30.0)


@router.get("/live/events", response_class=StreamingResponse)
async def events(
    request: Request,
    service: Parts,
    who: Reader,
    kinds: Kinds = None,
    since: Since = None,
    last_event_id: Annotated[str | None, Header(max_length=20)] = None,
) -> StreamingResponse:
    """The live stream as server-sent events."""
    _room(service)
    if since is None and last_event_id is not None and last_event_id.isdecimal():
        since = int(last_event_id)
    client = service.bus.subscribe(since, _kinds(kinds))
    headers = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}
    return StreamingResponse(_sse(service, client), media_type="text/event-stream", headers=headers)


@router.websocket("/live/ws")
async def socket(ws: WebSocket, service: Parts, kinds: Kinds = None, since: Since = None) -> None:
    """The live stream as a WebSocket."""
    try:
        require(ws.scope["state"]["principal"], "read")
        _room(service)
    except Problem as problem:
        await ws.close(1008, problem.detail[:120])
        return
    await ws.accept()
    client = service.bus.subscribe(since, _kinds(kinds))
    listener = asyncio.create_task(_until_gone(ws))
    try:
        await ws.send_text(_hello(service))
        told = 0
        while not service.closing and not listener.done():
            batch = await client.next(_patience(service))
            if client.dropped != told:
                told = client.dropped
                await ws.send_text(_dropped(client))
            for event in batch:
                if event.samples is None:
                    await ws.send_text(event.text)
                else:
                    await ws.send_bytes(event.binary)
            if not batch:
                await ws.send_text('{"kind":"alive"}')
        if not listener.done():
            await ws.close(1012, "the service is shutting down")
    except (WebSocketDisconnect, RuntimeError):
        pass  # the client left in the middle of a frame
    finally:
        listener.cancel()
        service.bus.unsubscribe(client)


async def _until_gone(ws: WebSocket) -> None:
    """Return when the client leaves; what it says is ignored."""
    with contextlib.suppress(WebSocketDisconnect, RuntimeError):
        while True:
            message = await ws.receive()
            if message["type"] == "websocket.disconnect":
                return


async def _sse(service: Service, client: Subscription) -> AsyncIterator[str]:
    try:
        yield f"event: hello\ndata: {_hello(service)}\n\n"
        told = 0
        while not service.closing:
            batch = await client.next(_patience(service))
            if client.dropped != told:
                told = client.dropped
                yield f"event: dropped\ndata: {_dropped(client)}\n\n"
            yield "".join(map(_frame, batch)) or ": alive\n\n"
    finally:
        service.bus.unsubscribe(client)


def _frame(event: Event) -> str:
    return f"id: {event.seq}\nevent: {event.kind}\ndata: {event.text}\n\n"


def _hello(service: Service) -> str:
    return f'{{"kind":"hello","seq":{service.bus.seq},"service":"{service.bus.born}"}}'


def _dropped(client: Subscription) -> str:
    return f'{{"kind":"dropped","data":{{"dropped":{client.dropped}}}}}'


def _patience(service: Service) -> float:
    # Streams look for the shutdown at least once a second.
    return min(1.0, service.settings.live.keep_alive_s)


def _kinds(text: str | None) -> frozenset[str] | None:
    return frozenset(text.split(",")) if text else None


def _room(service: Service) -> None:
    limit = service.settings.live.max_clients
    if service.bus.clients >= limit:
        raise Problem(503, "live-full", f"live.max_clients={limit} streams are open already")
