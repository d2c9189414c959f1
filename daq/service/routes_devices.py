"""Devices: what is plugged in, and what is missing to see more."""

import time
from typing import Any

from fastapi import APIRouter
from starlette.concurrency import run_in_threadpool

from daq.service import rig_facts
from daq.service.state import Parts, Reader
from daq.service.wire import Device

router = APIRouter(tags=["devices"])
FRESH_S = 5.0  # a search takes seconds and talks to the network: one serves all who ask meanwhile
_known: dict[str, Any] = {"at": float("-inf"), "devices": []}


@router.get("/devices")
async def devices(service: Parts, who: Reader) -> list[Device]:
    """Every device of every family; a family that cannot be searched says what is missing."""
    async with service.searching:
        if time.monotonic() - _known["at"] > FRESH_S:
            _known["devices"] = await run_in_threadpool(service.aside.ask, rig_facts.devices)
            _known["at"] = time.monotonic()
        return [Device(**row) for row in _known["devices"]]


@router.get("/rigs/{name}/facts")
def facts(name: str, service: Parts, who: Reader) -> dict[str, Any]:
    """A rig's channels, sample rate and output limits."""
    return rig_facts.shown(service.facts(name))
