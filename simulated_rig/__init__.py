"""A rig in software that stands behind the drivers' protocols. What is where:

the physics     `plant`, `tube`, `actuator`, `sensors`, `drift`, `operating`, `controllers`,
                `config`
what it lacks   `effects`, `seal` (drawn and kept from everybody), `presets`, `random_rigs`
in time         `statespace`, `etd`, `kernel`, `kernel_plain`, `simulation`, `fleet`, `cycle`
steady states   `orbits`, `continuation`, `stability`, `threads`
as a device     `rig`, `build`, `clocks`, `campaigns` (whole ones at once), `hil` (in real time,
                behind real ports)
"""

from simulated_rig.build import build_config, build_rig, noise_pa
from simulated_rig.campaigns import PlannedRun, plan_campaign, simulate_campaign, write_campaign
from simulated_rig.clocks import RealClock, VirtualClock
from simulated_rig.config import RigConfig
from simulated_rig.effects import EFFECTS, make_effect
from simulated_rig.operating import OperatingPoint
from simulated_rig.plant import Plant
from simulated_rig.presets import PRESETS
from simulated_rig.random_rigs import random_campaign, random_rig
from simulated_rig.rig import SimulatedRig
from simulated_rig.seal import SealedEffect, seal
from simulated_rig.tube import Tube, tube_plant

__all__ = [
    "EFFECTS",
    "PRESETS",
    "OperatingPoint",
    "PlannedRun",
    "Plant",
    "RealClock",
    "RigConfig",
    "SealedEffect",
    "SimulatedRig",
    "Tube",
    "VirtualClock",
    "build_config",
    "build_rig",
    "make_effect",
    "noise_pa",
    "plan_campaign",
    "random_campaign",
    "random_rig",
    "seal",
    "simulate_campaign",
    "tube_plant",
    "write_campaign",
]
