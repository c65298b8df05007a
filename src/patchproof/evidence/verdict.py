"""Derive the verdict on a promise, and the effect of the patch, from counts. Pure functions.

In: how many photographs of each session were recognized, the promise, counts of controls. Out: `kept`, `broken` or
`cannot_tell` with the prediction interval that decided it, and the effect (`shown` or not). For `assist`:

    broken       fewer are recognized than the 95 % prediction interval allows for in these sessions
    kept         the photographs' 97.5 % lower bound of the rate, which accounts for differences between sessions, is at
                 most 20 points under the promised rate, and no less than the best control's
    cannot_tell  otherwise; always below 5 judged photographs, or with more than 10 % of readable ones without a marker

mirrored for `deceive`, where a rate too high breaks the promise. `kept` is proved by the photographs; too few of them,
or all in one place, can prove nothing.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from patchproof.base.goal import Goal
from patchproof.base.intervals import CONFIDENCE, independent_difference, mcnemar_p, paired_difference, wilson
from patchproof.base.sessions import TAIL
from patchproof.evidence.results import Control, Effect, VerdictWord
from patchproof.sheets.manifest import Promise

LEAST_JUDGED = 5
MOST_WITHOUT_MARKERS = 0.10
RATE_SLACK = 0.20  # how far below the promised rate the proved rate may be
LEAST_PAIRS = 6  # fewer pairs can never reach 5 % in McNemar's test; the unpaired interval is used then
PHOTOS_PER_SESSION = 10  # photographs that are advised in each session
MIN_KEPT_CHANCE = 0.80  # chance of `kept` for which sessions are advised
MOST_PHOTOS = 150  # that are advised: nobody takes more
LEAST_PAIRED = 0.5  # of either folder's photographs: a few names that happen to be equal are no pairs


@dataclass(frozen=True)
class Verdict:
    """The verdict, the counts that the promise allows for, and one sentence with the figures that decided it."""

    verdict: VerdictWord
    prediction_interval: tuple[int, int] | None
    reason: str


def judge(recognized: int, photos: Sequence[int], promise: Promise, without_markers: int = 0) -> Verdict:
    """Judge the promise by `photos` (how many in each session), of which `recognized` were recognized;
    `without_markers` more are readable and show no marker.
    """
    judged, goal = sum(photos), promise.target.goal
    if judged == 0:
        return Verdict("cannot_tell", None, "No photograph could be judged.")
    posterior = promise.posterior
    low, high = posterior.count_interval(photos)
    sessions = "one session" if len(photos) == 1 else f"{len(photos)} sessions"
    allowed = f"the promise allows for {low} to {high} in {sessions}"
    share = _share_without_markers(judged, without_markers)
    if share > MOST_WITHOUT_MARKERS:
        reason = f"{without_markers} readable photographs show no marker ({share:.0%}, at most 10 % are allowed)."
        return Verdict("cannot_tell", (low, high), reason)
    if judged < LEAST_JUDGED:
        return Verdict("cannot_tell", (low, high), f"Only {judged} photographs could be judged; at least 5 are needed.")
    counts = f"{recognized} of {judged} photographs were recognized"
    if goal.sign * (recognized - (low if goal.sign > 0 else high)) < 0:
        return Verdict("broken", (low, high), f"{counts}; {allowed}.")
    ends = posterior.least_rate if goal.sign > 0 else posterior.most_rate
    proved, required = ends(recognized, photos, TAIL), required_rate(promise)
    side = "at least" if goal.sign > 0 else "at most"
    counts = f"{counts}; {allowed}. They prove a rate of {side} {proved:.0%}, and {side} {required:.0%} is asked for"
    return Verdict("kept" if goal.sign * (proved - required) >= 0 else "cannot_tell", (low, high), f"{counts}.")


def required_rate(promise: Promise) -> float:
    """The rate that photographs have to prove: 20 points worse than promised, and no worse than the best control's."""
    sign = promise.target.goal.sign
    controls = (sign * control.rate for control in promise.controls.values())
    return sign * max([sign * promise.rate - RATE_SLACK, *controls])


def kept_chance(promise: Promise, photos: Sequence[int]) -> float:
    """The chance that photographs (`photos` in each session) prove the promise, if it holds."""
    chances = promise.posterior.chances(photos)
    # from the worst count to the best: all counts after the first that is kept are kept, too
    counts = range(len(chances))[:: promise.target.goal.sign]
    first = bisect_left(counts, True, key=lambda count: judge(count, photos, promise).verdict == "kept")
    return float(chances[list(counts[first:])].sum())


def sessions_needed(promise: Promise) -> int | None:
    """The number of sessions of `PHOTOS_PER_SESSION` photographs that prove the promise, if it holds, with a chance of
    `MIN_KEPT_CHANCE`; None if that takes more than `MOST_PHOTOS` photographs.
    """
    counts = range(1, MOST_PHOTOS // PHOTOS_PER_SESSION + 1)
    return next((s for s in counts if kept_chance(promise, (PHOTOS_PER_SESSION,) * s) >= MIN_KEPT_CHANCE), None)


def next_step(promise: Promise, photos: Sequence[int], without_markers: int = 0) -> str:
    """Advise what to do if photographs (`photos` judged in each session) cannot tell."""
    if _share_without_markers(sum(photos), without_markers) > MOST_WITHOUT_MARKERS:
        return "Leave out pictures that do not show the piece, and take again those whose markers cannot be read."
    return photos_line(sessions_needed(promise), photos)


def photos_line(sessions: int | None, photos: Sequence[int] = ()) -> str:
    """Advise how many photographs to take for `sessions` (None: no number would do), after `photos` in each so far."""
    if sessions is None:
        return f"No {MOST_PHOTOS} photographs are likely to prove this promise: make a design that gains more."
    each, places, total = PHOTOS_PER_SESSION, places_text(sessions), PHOTOS_PER_SESSION * sessions
    if sum(photos) >= total and len(photos) >= sessions:
        return f"Take {total} more, {each} in each of {places} that are new."
    needed = (
        f"Take at least {each} photographs in each of {places}, with other light in each, and keep those of each place "
        "in a folder of their own."
    )
    so_far = f" So far: {sum(photos)} of {total}, in {places_text(len(photos))} of {sessions}."
    return needed + so_far if photos else needed


def places_text(count: int) -> str:
    """'1 place' or 'N places'."""
    return "1 place" if count == 1 else f"{count} places"


def _share_without_markers(judged: int, without_markers: int) -> float:
    return without_markers / max(judged + without_markers, 1)


def compare_with_control(patch: Mapping[str, bool], name: str, control: Mapping[str, bool], goal: Goal) -> Control:
    """Compare answers to the patch with those to a control, both by file name; equal names are pairs. `shown` says
    whether the patch changes recognition in the goal's direction, at 95 %.
    """
    counts = sum(control.values()), len(control)
    row = Control(name, *counts, wilson(*counts))
    if not patch or not control:
        return row
    names = sorted(patch.keys() & control.keys())
    if len(names) >= max(LEAST_PAIRS, LEAST_PAIRED * len(patch), LEAST_PAIRED * len(control)):
        a, b = [patch[name] for name in names], [control[name] for name in names]
        difference, interval = paired_difference(a, b)
        p_value = mcnemar_p(a, b)
        shown = p_value < 1 - CONFIDENCE and goal.sign * difference > 0
        pairs = len(names)
    else:
        difference, interval = independent_difference(sum(patch.values()), len(patch), *counts)
        shown, p_value, pairs = min(goal.sign * end for end in interval) > 0, None, 0
    return replace(row, pairs=pairs, difference=difference, difference_interval=interval, p_value=p_value, shown=shown)


def effect_of(controls: Sequence[Control]) -> Effect:
    """The effect is `shown` if every control was beaten; controls without a judged photograph do not count."""
    answers = [control.shown for control in controls if control.shown is not None]
    if not answers:
        return "not_tested"
    return "shown" if all(answers) else "not_shown"
