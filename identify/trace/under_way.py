"""A search under way: what it works on, all that has been tried so far, and what that says.

The steps (`law_steps`, `chance_steps`, `contesting`) are functions of it; `selection` orders them.
"""

import time
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from identify.dataset import Dataset
from identify.effect import Effect
from identify.effects.scatter import Scatter
from identify.executor import Executor, Progress
from identify.fit import Fit
from identify.start import other_minima
from identify.structure import Structure
from identify.trace.claims import accounts, against_chance
from identify.trace.contests import BEHIND
from identify.trace.tried import Tried, astray, best_form, misfit, tried

MINIMA = 2  # of the declared model, beside the deepest, from which effects are sought


@dataclass
class UnderWay:
    """A search under way: what it works on, and all that has been tried so far."""

    structure: Structure
    data: Dataset
    base: Fit
    run: Executor
    report: Progress
    available: tuple[Effect, ...]
    fuller: tuple[Effect, ...]  # forms for more modes, beside an effect that brings them
    scatters: tuple[Scatter, ...]
    until: float = np.inf
    left_out: bool = False  # a step, for want of time
    tried: list[Tried] = field(default_factory=list)
    extended: dict[tuple[str, ...], float] = field(default_factory=dict)  # grown from, χ² there …
    done: set[tuple[str, ...]] = field(default_factory=set)  # … and seen to in other forms
    found: set[tuple[str, ...]] = field(default_factory=set)  # alone, and contested

    def late(self) -> bool:
        """Whether no more than what has been found is to be looked at; asked before each step that
        seeks an explanation, which is left out then."""
        if time.monotonic() > self.until:
            self.left_out = True
        return self.left_out

    def seeking(self) -> bool:
        """Whether nothing explains the data yet, and there is time to go on."""
        return not (self.explained or self.late())

    @property
    def apart(self) -> list[Effect]:
        """The forms that need no other to start from."""
        return [e for e in self.available if not e.refines]

    @property
    def forms(self) -> tuple[Effect, ...]:
        """All forms, beside whatever they may stand."""
        return (*self.available, *self.fuller)

    @property
    def only_fuller(self) -> list[Effect]:
        """Forms for more modes of which there is none for the declared ones."""
        known = {e.key for e in self.available}
        return [e for e in self.fuller if e.key not in known]

    @property
    def explaining(self) -> list[Tried]:
        """What explains the data, once laws have spoken against chance."""
        return [t for t in against_chance(self.tried) if t.explains]

    @property
    def explained(self) -> bool:
        return bool(self.explaining)

    @property
    def accounted(self) -> bool:
        """Whether something explains the data that the misfit goes with, so that it may be said."""
        return any(accounts(t, self.declared, self.tried) for t in self.explaining)

    @cached_property
    def declared(self) -> Tried:
        return tried((), self.base, self.data)

    @cached_property
    def minima(self) -> tuple[Fit, ...]:
        """Other minima of the declared model, where it is near enough to the data to have some."""
        if astray(self.base):
            return ()
        return tuple(other_minima(self.structure, self.data, self.base, BEHIND)[:MINIMA])

    @property
    def by_chance(self) -> bool:
        """Whether a spread explains the data by itself: what else is in them is within it."""
        return any(t.explains for t in self.spreads_alone)

    @property
    def by_law(self) -> bool:
        """Whether laws explain the data without chance."""
        return any(t.explains for t in self.laws)

    @property
    def laws(self) -> list[Tried]:
        return [t for t in self.tried if t.spread is None]

    @property
    def spreads_alone(self) -> list[Tried]:
        return [t for t in self.tried if t.spread is not None and len(t.effects) == 1]

    @property
    def best(self) -> Tried | None:
        """What would be claimed."""
        good = self.explaining
        return best_form(good) if good else None

    @property
    def best_law(self) -> Tried | None:
        """The same, if that is without chance."""
        best = self.best
        return None if best is None or best.spread is not None else best


def as_a_parent(t: Tried) -> float:
    """Misfit; what has not converged may be at no place to grow from."""
    return misfit(t) * (1.0 if t.fit.converged else BEHIND)
