"""Simulated rigs: what they can be made of, make one, remove it, reveal what it carried."""

from typing import Any

from fastapi import APIRouter

from daq.service import rig_facts
from daq.service.control import lane
from daq.service.problems import Problem
from daq.service.rigs import SIMULATED, RigEntry
from daq.service.routes_rigs import describe
from daq.service.state import Configurer, Parts, Reader
from daq.service.wire import Rig, RigOptions, SimulatedRigRequest, Truth

router = APIRouter(tags=["simulated rigs"])


@router.get("/simulated-rigs/options")
def options(service: Parts, who: Reader) -> RigOptions:
    """Presets and effects, with each effect's parameters and units."""
    return RigOptions(**service.aside.ask(rig_facts.simulated_options))


@router.post("/simulated-rigs", status_code=201)
def create(body: SimulatedRigRequest, service: Parts, who: Configurer) -> Rig:
    """Add a simulated rig. A sealed one carries an effect that only `reveal` tells."""
    chosen: dict[str, Any] = body.model_dump(exclude={"name", "max_amplitude_v"}, exclude_none=True)
    if body.max_amplitude_v is not None:
        chosen["limits"] = {"max_amplitude_v": body.max_amplitude_v}
    entry = RigEntry(body.name, SIMULATED, chosen, "added")
    service.aside.ask(rig_facts.facts, entry)
    service.rigs.add(entry)
    shown = {key: value for key, value in chosen.items() if key != "effects"}
    service.audit.record(who.name, "add simulated rig", body.name, **shown)
    return describe(service, body.name)


@router.delete("/simulated-rigs/{name}", status_code=204)
def remove(name: str, service: Parts, who: Configurer) -> None:
    """Remove a simulated rig that was added; its campaigns stay."""
    service.check_rig(name)
    if service.jobs.running(lane(name)):
        raise Problem(409, "running", f"rig {name!r} is running: stop it first")
    service.rigs.remove(name)
    service.audit.record(who.name, "remove simulated rig", name)


@router.post("/simulated-rigs/{name}/reveal")
def reveal(name: str, service: Parts, who: Configurer) -> Truth:
    """The truth about a simulated rig: what it carries that the declared model lacks."""
    entry = service.check_rig(name)
    if entry.driver != SIMULATED:
        raise Problem(409, "not-simulated", f"rig {name!r} is real: nobody knows the truth")
    service.audit.record(who.name, "reveal", name)
    return Truth.model_validate(service.aside.ask(rig_facts.truth, entry.options))
