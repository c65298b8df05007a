"""The shot plan: how many photographs to take, in how many places, from where and of which controls, so that the
verdict will not be `cannot_tell`.

In: a promise and the scene's ranges. Out: counts, and sentences for the sheet's last page. Photographs of one session
are alike, so that a few in each of several places prove more than many in one: for some numbers of photographs and
sessions, the counts that the promise allows for and the chance that they prove it. For an effect, the number of
photographs with which McNemar's exact test of pairs, or Newcombe's interval without pairs, has 90 % power. Assumed: the
promise holds, and design and control are recognized independently at their promised rates, which asks for more
photographs than pairs of one view need.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from patchproof.base.intervals import CONFIDENCE, wilson
from patchproof.base.sessions import split_evenly
from patchproof.base.settings import SceneSettings, background_summary
from patchproof.evidence import verdict
from patchproof.optimizer.promise import PROMISE_VIEWS
from patchproof.sheets.manifest import Promise

POWER = 0.90
SHOT_COUNTS = ((40, 1), (40, 2), (40, 4), (40, 8), (80, 8))  # photographs, sessions
STEADY_COUNTS = 12  # consecutive counts that must suffice: bounds are whole photographs, so that some n just miss


@dataclass(frozen=True)
class ShotOption:
    """A number of photographs and sessions, the counts that the promise allows for, and the chance to prove it."""

    photos: int
    sessions: int
    allowed: tuple[int, int]
    chance: float


@dataclass(frozen=True)
class ShotPlan:
    """Options for taking photographs, sessions that a verdict needs (None: more than 150 photographs), the best
    control, and photographs that an effect needs with and without pairs (None: more than 150).
    """

    options: tuple[ShotOption, ...]
    sessions: int | None
    control: str
    paired: int | None
    unpaired: int | None


def plan_shots(promise: Promise) -> ShotPlan:
    """Compute the counts for a promise; those for an effect follow from the control that is hardest to beat."""
    best = promise.best_control
    better, worse = (promise.rate, promise.controls[best].rate)[:: promise.target.goal.sign]
    of_counts, splits = promise.posterior.count_interval, [(c, split_evenly(*c)) for c in SHOT_COUNTS]
    return ShotPlan(
        options=tuple(ShotOption(*c, of_counts(p), verdict.kept_chance(promise, p)) for c, p in splits),
        sessions=verdict.sessions_needed(promise),
        control=best,
        paired=fewest_photos(lambda n: paired_power(better, worse, n) >= POWER),
        unpaired=fewest_photos(lambda n: unpaired_power(better, worse, n) >= POWER),
    )


def fewest_photos(enough: Callable[[int], bool]) -> int | None:
    """The smallest n from 5 to 150 from which on n photographs are enough; None if there is none."""
    run = 0
    for n in range(5, verdict.MOST_PHOTOS + STEADY_COUNTS):
        run = run + 1 if enough(n) else 0
        if run == STEADY_COUNTS:
            return n - STEADY_COUNTS + 1
    return None


def paired_power(better: float, worse: float, n: int) -> float:
    """The chance that McNemar's exact test on n independent pairs shows the better rate to be better."""
    from scipy.stats import binom

    only_better, only_worse = better * (1 - worse), worse * (1 - better)
    differing = only_better + only_worse
    if differing <= 0:
        return 0.0
    counts = np.arange(1, n + 1)
    # more pairs in favor than this are significant, both tails
    insignificant = binom.isf((1 - CONFIDENCE) / 2, counts, 0.5)
    return float(binom.pmf(counts, n, differing) @ binom.sf(insignificant, counts, only_better / differing))


def unpaired_power(better: float, worse: float, n: int) -> float:
    """The chance that Newcombe's interval of the difference, with n photographs each, lies above zero."""
    from scipy.stats import binom

    counts = np.arange(n + 1)
    rates, (low, high) = counts / n, np.transpose([wilson(k, n) for k in range(n + 1)])
    # the interval's lower limit by the count of the better (rows) and that of the worse (columns)
    limits = rates[:, None] - rates - np.sqrt((rates - low)[:, None] ** 2 + (high - rates) ** 2)
    return float(binom.pmf(counts, n, better) @ (limits > 0) @ binom.pmf(counts, n, worse))


def shot_sections(promise: Promise, settings: SceneSettings) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Say how many photographs to take, and from where, as (heading, lines)."""
    plan = plan_shots(promise)
    comparison = promise.headline.removeprefix(promise.draft_prefix)
    background = background_summary(settings.model_dump())
    summary = f"{promise.draft_prefix or 'The design is '}{comparison} Promised before {background}."
    counts = (summary, *_count_lines(promise, plan))
    return (("How many photographs", counts), ("From where", _view_lines(settings)))


def _count_lines(promise: Promise, plan: ShotPlan) -> tuple[str, ...]:
    control = promise.controls[plan.control]
    lines = [
        f"Promised: {promise.rate:.0%} recognized as {promise.target.label}, of {promise.n} views in "
        f"{promise.sessions} sessions, each with a place, light, camera and print of its own; the best control "
        f"({plan.control}) {control.rate:.0%}."
    ]
    options = (
        f"{o.photos} in {verdict.places_text(o.sessions)}: {o.allowed[0]} to {o.allowed[1]} ({o.chance:.0%})"
        for o in plan.options
    )
    lines.append(
        f"A verdict asks the photographs to prove a rate of {verdict.required_rate(promise):.0%}. What they will show "
        f"if the promise holds, and the chance that it is enough: {'; '.join(options)}."
    )
    lines.append(verdict.photos_line(plan.sessions))
    if promise.n < PROMISE_VIEWS and not promise.draft:
        lines.append(
            f"A promise of {PROMISE_VIEWS} views (patchproof promise RUN --n {PROMISE_VIEWS}, then this page again) "
            "knows better how much places differ, and often asks for fewer of them."
        )
    if plan.paired is None and plan.unpaired is None:
        no_gain = f"that the patch beats {plan.control}: it is not promised to, or by too little."
        return (*lines, f"No {verdict.MOST_PHOTOS} photographs would show {no_gain}")
    pairs = plan.paired if plan.paired is not None else plan.unpaired
    kind = "bare object (without any marker)" if plan.control == "bare" else f"{plan.control} control"
    lines.append(
        f"To show that the patch makes the difference (90 % power): {pairs} pairs, each view once with the piece and "
        f"once with the {kind} in the same place and light, saved under equal file names in a folder of its own."
    )
    if plan.unpaired is not None:
        lines.append(f"Without pairs: {plan.unpaired} of each.")
    lines.append(
        "Print the other controls (mean, gray, noise) too, if you can: the effect is shown only where the patch beats "
        "every control that you photograph."
    )
    return tuple(lines)


def _view_lines(settings: SceneSettings) -> tuple[str, ...]:
    if settings.object.mesh is None:
        return ("As the scene's own photographs were taken: the same places, distances and light.",)
    view, patch = settings.view, settings.patch
    target = "object" if view.look_at == "object" else "piece"
    light = "Light as it comes" if settings.light.ambient[0] < 1 else "Bright light"
    front = "the place of the piece" if patch.at_mm is not None else f"the piece's side ({patch.side})"
    if view.front != "patch":
        front = f"the object's {view.front} side"
    return (
        f"Spread over all of these, not the best ones: {_degrees(view.azimuth_deg)} to the left (-) and right (+) of "
        f"facing {front}, {_degrees(view.elevation_deg)} above it, "
        f"{view.distance_mm[0] / 10:.0f} to {view.distance_mm[1] / 10:.0f} cm from the middle of the {target}, the "
        f"camera turned by {_degrees(view.roll_deg)}.",
        f"The {target} belongs in the middle of the picture, the whole piece in view; classifiers see the picture's "
        "centered square.",
        f"{light}, without flash, shine or filters; views outside of these ranges are not counted.",
    )


def _degrees(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:g}° to {bounds[1]:g}°"
