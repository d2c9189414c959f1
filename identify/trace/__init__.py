"""From residual to cause: which effect the declared model lacks, where, how large, how sure.

1. Is there anything to explain? Whitened lack of fit on the fitted and on the validation runs, and
   score tests (`scores`).
2. Every form of every candidate effect is added to the declared model and refitted in stages
   (`stages`).
3. If no single effect explains the data to within noise, run-to-run scatter is tried, and pairs are
   grown from the best singles, then triples (`selection`, `law_steps`); scatter beside an effect,
   and effects beside scatter, at more noise where both are gross (`chance_steps`). Where even the
   best single leaves a gross misfit and does not stand out, pairs are sought at once, from the slow
   flow corrected for both effects (`pairs`); where no pair comes near, several modes may be lacking
   beside another effect. An effect stays only if leaving it out makes the fit significantly worse
   (`fewer`); other forms are tried, others in the place of each and of all (`contests`, by
   `exchange`), and what had not converged is led `to_the_end`.
4. What explains the data must also have come to values, predict the validation runs, lie in its
   plausible range, take most of the misfit away by more than chance, and have no rival: another
   effect that does as well, complexity counted (`tried`), nor, where it leaves more than noise
   mostly does, a freely shaped piece that is far likelier; a spread, no spread at another place.
5. Where nothing explains the data, freely shaped pieces and the single effects say where in the
   loop it lies; a memory, and runs that each deviate, where no smooth shape does (`places`). Where
   none of all these but a spread, or one law beside one, comes near, that is claimed though it
   looks a little less random, or leaves a little more, than most: with no law to hide, it is
   (`claims.unrivalled`).
6. Before nothing, several effects, a spread or a law of many numbers is said, each run is left out:
   where one alone contradicts the declared model, its recording is doubted (`lone`).
"""

from identify.trace.again import started_again
from identify.trace.claims import (
    accounts,
    against_chance,
    but_for_values,
    candidate,
    claimed,
    other_forms,
    outdone,
    rivals,
    unrivalled,
)
from identify.trace.lone import lone_run
from identify.trace.places import deviating, remembering, shaped, whereabouts
from identify.trace.scores import ScoreTest, family_p, score_tests
from identify.trace.selection import Cancelled, refitted, search, without_effects
from identify.trace.stages import try_effects
from identify.trace.tried import ALPHA, EVIDENCE, Tried, astray, best_by_name, best_form, foremost
from identify.trace.usable import usable

__all__ = [
    "ALPHA",
    "EVIDENCE",
    "Cancelled",
    "ScoreTest",
    "Tried",
    "accounts",
    "against_chance",
    "astray",
    "best_by_name",
    "best_form",
    "but_for_values",
    "candidate",
    "claimed",
    "deviating",
    "family_p",
    "foremost",
    "lone_run",
    "other_forms",
    "outdone",
    "refitted",
    "remembering",
    "rivals",
    "score_tests",
    "search",
    "shaped",
    "started_again",
    "try_effects",
    "unrivalled",
    "usable",
    "whereabouts",
    "without_effects",
]
