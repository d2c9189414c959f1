"""Many rigs at once: the compiled loop releases Python's lock, so threads use all cores."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

from simulated_rig.simulation import Simulation
from simulated_rig.statespace import FloatArray


def run_fleet(
    rigs: Sequence[Simulation],
    drives: Sequence[FloatArray],
    stride: int = 1,
    workers: int | None = None,
) -> list[FloatArray]:
    """`Simulation.run` of each rig with its drive, in order; the rigs must be different objects.

    Raises
    ------
    ValueError
        When there are not as many drives as rigs, or a rig appears twice.
    """
    if len(drives) != len(rigs):
        raise ValueError(f"len(drives)={len(drives)} is not len(rigs)={len(rigs)}")
    if len({id(rig) for rig in rigs}) != len(rigs):
        raise ValueError("rigs holds one rig twice; a simulation has one state")
    count = workers or os.cpu_count() or 1
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(lambda rig, drive: rig.run(drive, stride), rigs, drives))
