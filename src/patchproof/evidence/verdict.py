"""Derive the verdict on a promise, and the effect of the patch, from counts. Pure functions.

In: how many photographs of each session were recognized, the promise, counts of controls. Out: `kept`, `broken` or
`cannot_tell` with the prediction interval that decided it, and the effect (`shown` or not). For `assist`:

    broken       fewer are recognized than the 95 % prediction interval allows for in these sessions
    kept         the photographs' 97.5 % lower bound of the rate, which accounts for differences between sessions, is at
                 most 20 points under the promised rate, and no less than the best control's
    cannot_tell  otherwise; always below 5 judged photographs, or with more than 10 % of readable ones without a marker

mirrored for `deceive`, where a rate too high breaks the promise. `kept` is proved by the photographs; too few of them,
or all in one place, can prove nothing. Looking again after each session until it fits would find `kept` falsely in 9 to
18 % of trials: looks are counted, and the bound of those that were not planned is stricter (see `Look`).
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from patchproof.base.goal import Goal
from patchproof.base.intervals import wilson
from patchproof.base.sessions import LEAST_SESSIONS, TAIL, sessions_difference
from patchproof.evidence.results import Control, Effect, VerdictWord
from patchproof.sheets.manifest import Promise

LEAST_JUDGED = 5
MOST_WITHOUT_MARKERS = 0.10
RATE_SLACK = 0.20  # how far below the promised rate the proved rate may be
LEAST_PAIRS = 6  # fewer pairs can never reach 5 %; photographs are compared as different ones then
PHOTOS_PER_SESSION = 10  # photographs that are advised in each session
MIN_KEPT_CHANCE = 0.80  # chance of `kept` for which sessions are advised
MOST_PHOTOS = 150  # that are advised: nobody takes more
LEAST_PAIRED = 0.5  # of either folder's photographs: a few names that happen to be equal are no pairs
ONE_SESSION_ADVICE = (
    "one place cannot tell what the patch does from what the place does: photograph both in "
    "two places or more, better in four, with the control's photographs of each in a folder named as the patch's"
)

PhotoKey = tuple[int, str]  # the number of a session, and a photograph's name in it
Answers = Mapping[PhotoKey, bool]


@dataclass(frozen=True)
class Verdict:
    """The verdict, the counts that the promise allows for, and one sentence with the figures that decided it."""

    verdict: VerdictWord
    prediction_interval: tuple[int, int] | None
    reason: str


@dataclass(frozen=True)
class Look:
    """The number of this look at photographs that were judged before, and that of the look that was planned."""

    number: int = 1
    planned: int = 1

    @property
    def tail(self) -> float:
        """The chance of a false `kept` that this look may spend: 2.5 % for the planned one, and 2.5 % for all others
        together, k-th of which gets the share 1 / (k (k + 1)) (Bonferroni's bound, so that any dependence is allowed).
        """
        k = self.number - (self.number > self.planned)
        return TAIL if self.number == self.planned else TAIL / (k * (k + 1))


PLANNED_LOOK = Look()


def watched(photos: Sequence[int], promise: Promise) -> Look:
    """The look at photographs (`photos` in each session) that were watched while they were taken: one each session."""
    return Look(max(len(photos), 1), sessions_needed(promise) or MOST_PHOTOS // PHOTOS_PER_SESSION)


def judge(
    recognized: int, photos: Sequence[int], promise: Promise, without_markers: int = 0, look: Look = PLANNED_LOOK
) -> Verdict:
    """Judge the promise by `photos` (how many in each session), of which `recognized` were recognized;
    `without_markers` more are readable and not located. Looks besides the planned one ask for more proof.
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
        found = f"{without_markers} readable photographs show no marker or corners"
        return Verdict("cannot_tell", (low, high), f"{found} ({share:.0%}, at most 10 % are allowed).")
    if judged < LEAST_JUDGED:
        return Verdict("cannot_tell", (low, high), f"Only {judged} photographs could be judged; at least 5 are needed.")
    counts = f"{recognized} of {judged} photographs were recognized"
    if goal.sign * (recognized - (low if goal.sign > 0 else high)) < 0:
        return Verdict("broken", (low, high), f"{counts}; {allowed}.")
    ends = posterior.least_rate if goal.sign > 0 else posterior.most_rate
    proved, required = ends(recognized, photos, look.tail), required_rate(promise)
    side = "at least" if goal.sign > 0 else "at most"
    certain = "" if look.tail == TAIL else f" (with {1 - look.tail:.2%} certainty, as for look {look.number})"
    proof = f"They prove a rate of {side} {proved:.0%}{certain}, and {side} {required:.0%} is asked for."
    word: VerdictWord = "kept" if goal.sign * (proved - required) >= 0 else "cannot_tell"
    return Verdict(word, (low, high), f"{counts}; {allowed}. {proof}")


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


def compare_with_control(patch: Answers, name: str, control: Answers, goal: Goal) -> Control:
    """Compare answers to the patch with those to a control, both by session and photograph; equal keys are pairs, if at
    least half of either are. `shown` says whether the patch changes recognition in the goal's direction, at 95 % over
    sessions.
    """
    counts = sum(control.values()), len(control)
    row = Control(name, *counts, wilson(*counts))
    if not patch or not control:
        return replace(row, advice=f"no photograph of {'it' if patch else 'the patch'} could be judged")
    keys = sorted(patch.keys() & control.keys())
    paired = len(keys) >= max(LEAST_PAIRS, LEAST_PAIRED * len(patch), LEAST_PAIRED * len(control))
    a, b = (_by_session(answers, keys if paired else sorted(answers)) for answers in (patch, control))
    difference, interval = sessions_difference(a, b, paired)
    shown = min(goal.sign * end for end in interval) > 0
    count, pairs = min(len(a), len(b)), len(keys) if paired else 0
    row = replace(row, sessions=count, pairs=pairs, difference=difference, difference_interval=interval, shown=shown)
    return row if count >= LEAST_SESSIONS else replace(row, advice=ONE_SESSION_ADVICE)


def _by_session(answers: Answers, keys: Sequence[PhotoKey]) -> dict[int, list[bool]]:
    return {session: [answers[key] for key in keys if key[0] == session] for session, _ in keys}


def effect_of(controls: Sequence[Control]) -> Effect:
    """The effect is `shown` if every control was beaten; one without a judged photograph was not."""
    if all(control.shown is None for control in controls):
        return "not_tested"
    return "shown" if all(control.shown for control in controls) else "not_shown"
