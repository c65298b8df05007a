"""Derive the verdict on a promise from counts, tell whether the patch helps, say what is still needed.

In: how many photographs of each session were recognized, the promise, counts of controls. Out: `kept`, `broken` or
`cannot_tell` with the prediction interval that decided it; differences; how many photographs would tell. For `assist`:

    broken       fewer are recognized than the 95 % prediction interval allows for in these sessions
    kept         the photographs' 97.5 % lower bound of the rate, which accounts for differences between sessions, is at
                 most 20 points under the promised rate, and no less than the best control's
    cannot_tell  otherwise; always below 5 judged photographs, or with more than 10 % of readable ones without a marker

mirrored for `deceive`, where a rate too high breaks the promise. `kept` is proved by the photographs; too few of them,
or all in one place, can prove nothing. Looking again after each session until it fits would find `kept` falsely in 9 to
18 % of trials: looks are counted, and the bound of those that were not planned is stricter (see `Look`).

Whether the patch helps is another question: a patch that was promised to be useless, and is, keeps its promise. The
headline, the page and `--require helps` answer it by one comparison, with the hardest control of the strongest kind:
photographed controls, if there are any; else those rendered into the patch's own photographs, and the bare object as
the promise simulated it, since the paper hides it; else the promise's controls. `base.goal` says which answer it gives.
"""

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from operator import itemgetter

import numpy as np

from patchproof.base.intervals import rates_difference, wilson
from patchproof.base.sessions import LEAST_SESSIONS, TAIL, sessions_difference
from patchproof.evidence.results import Benefit, Control, ControlSource, EffectEstimate, VerdictWord
from patchproof.sheets.manifest import Interval, Promise

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
Rate = tuple[float, tuple[float, float]]  # with its interval


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
        found = f"{without_markers} of {judged + without_markers} readable photographs show no marker or corners"
        return Verdict("cannot_tell", (low, high), f"{found}; at most a tenth may.")
    if judged < LEAST_JUDGED:
        return Verdict("cannot_tell", (low, high), f"At least 5 judged photographs are needed, here: {judged}.")
    counts = f"{recognized} of {judged} photographs were recognized"
    if goal.sign * (recognized - (low if goal.sign > 0 else high)) < 0:
        return Verdict("broken", (low, high), f"{counts}; {allowed}.")
    ends = posterior.least_rate if goal.sign > 0 else posterior.most_rate
    proved, required = ends(recognized, photos, look.tail), required_rate(promise)
    side = "at least" if goal.sign > 0 else "at most"
    certain = "" if look.tail == TAIL else f" with {1 - look.tail:.2%} certainty, as for look {look.number}"
    proof = f"True rate {side} {proved:.0%}{certain} (needed: {required:.0%}).{useless_note(promise)}"
    word: VerdictWord = "kept" if goal.sign * (proved - required) >= 0 else "cannot_tell"
    return Verdict(word, (low, high), f"{counts}; {allowed}. {proof}")


def required_rate(promise: Promise) -> float:
    """The rate that photographs have to prove: 20 points worse than promised, and no worse than the best control's."""
    sign = promise.target.goal.sign
    controls = (sign * control.rate for control in promise.controls.values())
    return sign * max([sign * promise.rate - RATE_SLACK, *controls])


def useless_note(promise: Promise) -> str:
    """Say that a promise asks for nothing, as one of 15 % over controls at 0 %; "" if it asks for something."""
    is_empty = (sign := promise.target.goal.sign) * required_rate(promise) <= min(sign, 0)
    return " This promise asks for nothing: any photographs keep it." * is_empty


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


def provable_gain(promise: Promise, sessions: int, photos: int) -> float | None:
    """The least gain that `photos` in each of `sessions` places, and as many of a control, show with a chance of
    `MIN_KEPT_CHANCE`; None if none is large enough. Student's bound with as many degrees of freedom as sessions.
    """
    from scipy.special import stdtrit

    sign, correlation = promise.target.goal.sign, promise.posterior.correlation[0]
    quantiles = stdtrit(sessions, 1 - TAIL) + stdtrit(sessions, MIN_KEPT_CHANCE)
    for gain in np.arange(1, 101) / 100 if sessions >= LEAST_SESSIONS else ():
        mean = promise.rate - sign * gain / 2
        variance = 2 * mean * (1 - mean) * (1 / photos + correlation) / sessions
        if 0 <= promise.rate - sign * gain <= 1 and gain >= quantiles * variance**0.5:
            return float(gain)
    return None


def sessions_to_show(promise: Promise) -> int | None:
    """The number of sessions of `PHOTOS_PER_SESSION` photographs of the patch, and as many of its best control, that
    show the promised gain; None if `MOST_PHOTOS` of each do not, or if no gain worth having is promised.
    """
    if not promise.controls or promise.answer == "does_not_help":
        return None
    gain, each = promise.target.goal.sign * promise.controls[promise.best_control].difference, PHOTOS_PER_SESSION
    counts = range(LEAST_SESSIONS, MOST_PHOTOS // each + 1)
    return next((s for s in counts if gain >= (provable_gain(promise, s, each) or 1.0)), None)


def still_needed(
    promise: Promise, photos: Sequence[int], without_markers: int, verdict: VerdictWord, worth: Benefit | None
) -> str:
    """Say what is still needed, after `photos` judged in each session, to tell both answers; "" if they are told."""
    control = worth.control if worth is not None and worth.word == "cannot_tell" else ""
    if verdict != "cannot_tell" and not control:
        return ""
    if _share_without_markers(sum(photos), without_markers) > MOST_WITHOUT_MARKERS:
        do = "do what the report says of each, and leave out pictures that do not show the piece"
        return f"Too many photographs show no markers or corners: {do}."
    again = worth is None or worth.source == "photographed"
    return photos_line(promise, photos, control, verdict == "cannot_tell", again)


def photos_line(
    promise: Promise, photos: Sequence[int] = (), control: str = "", for_promise: bool = True, again: bool = False
) -> str:
    """Say how many photographs to take in all, after `photos` in each session so far: for a verdict on the promise, and
    with the name of a control to tell whether the patch helps; `again` if it was photographed so far.
    """
    kept, shown = sessions_needed(promise) if for_promise else 0, sessions_to_show(promise) if control else 0
    if shown is None or (kept is None and not control):
        proves = f"show that it {promise.target.goal.words['helps']}" if control else "prove this promise"
        unsure = control and promise.controls and promise.answer == "cannot_tell"
        first = f"promise it again first ({promise.command()}), or " if unsure else ""
        return f"Even {MOST_PHOTOS} photographs are unlikely to {proves}: {first}make a design that gains more."
    sessions, each = max(kept or 0, shown), PHOTOS_PER_SESSION
    places, total, what = places_text(sessions), each * sessions, ""
    if control:
        printed = f"its {control} control (patchproof sheet RUN --control {control})"
        what = f" of the patch and {each} of {'the bare object' if control == 'bare' else printed}"
    so_far = f" So far: {sum(photos)} of {total}, in {places_text(len(photos))} of {sessions}." if photos else ""
    if sum(photos) >= total and len(photos) >= sessions:
        so_far = f" So far: {sum(photos)} of the patch, in {places_text(len(photos))}."
        if again or not control:
            return f"Take {total} more{what and ' of each'}, {each} in each of {places} that are new."
    needed = (
        f"Take at least {each} photographs{what} in each of {places}, with other light in each, and keep those of each "
        "place in a folder of their own."
    )
    alone = f" The promise alone is proved in {places_text(kept)}." if control and kept and kept < sessions else ""
    weak = " The promise itself is too little above its best control." * (kept is None)
    return needed + alone + so_far + weak


def places_text(count: int) -> str:
    """'1 place' or 'N places'."""
    return "1 place" if count == 1 else f"{count} places"


def _share_without_markers(judged: int, without_markers: int) -> float:
    return without_markers / max(judged + without_markers, 1)


def compare_with_control(patch: Answers, name: str, control: Answers, promise: Promise) -> Control:
    """Compare answers to the patch with those to a control, both by session and photograph; equal keys are pairs, if at
    least half of either are. `shown` says whether the patch gains at all, at 95 % over sessions.
    """
    counts = sum(control.values()), len(control)
    row = Control(name, *counts, wilson(*counts))
    if not patch or not control:
        return replace(row, advice=f"no photograph of {'it' if patch else 'the patch'} could be judged")
    keys = sorted(patch.keys() & control.keys())
    paired = len(keys) >= max(LEAST_PAIRS, LEAST_PAIRED * len(patch), LEAST_PAIRED * len(control))
    hits, rates = [], []
    for answers in (patch, control):
        by_session = groupby(keys if paired else sorted(answers), itemgetter(0))
        hits.append({session: [answers[key] for key in group] for session, group in by_session})
        counts = sum(map(sum, hits[-1].values())), list(map(len, hits[-1].values()))
        rates.append((counts[0] / sum(counts[1]), promise.posterior.rate_given(*counts)))
    (a, b), ((rate, ours), (control_rate, theirs)) = hits, rates
    difference, interval = sessions_difference(a, b, paired)
    row = replace(row, interval=theirs, rates=(rate, control_rate), patch_interval=ours, difference=difference)
    count, pairs, shown = min(len(a), len(b)), len(keys) if paired else 0, promise.target.goal.gains(interval)[0] > 0
    row = replace(row, sessions=count, pairs=pairs, difference_interval=interval, shown=shown)
    return row if count >= LEAST_SESSIONS else replace(row, advice=ONE_SESSION_ADVICE)


def benefit_of(
    photos: int,
    rate: float,
    interval: Interval,
    controls: Sequence[Control],
    promise: Promise,
    estimate: EffectEstimate | None = None,
) -> Benefit | None:
    """Compare the patch, recognized at `rate` in `photos` photographs, with its controls; None if there are none."""
    goal, rows = promise.target.goal, dict[str, Benefit]()

    def add(name: str, source: ControlSource, count: int, ours: Rate, theirs: Rate, points: Rate, advice: str = ""):
        comparison = {"difference": points[0], "difference_interval": points[1], "photos": count, "advice": advice}
        sides = {"rate": ours[0], "interval": ours[1], "control_rate": theirs[0], "control_interval": theirs[1]}
        rows[name] = Benefit(goal=goal, word=goal.answer(points[1]), control=name, source=source, **comparison, **sides)

    photographed = any(c.rates for c in controls)
    for c in controls if photographed else estimate.controls if estimate else ():
        if c.rates and c.difference is not None and c.difference_interval and c.patch_interval:
            count = c.pairs or (photos if photographed else c.n)
            ours, theirs = (c.rates[0], c.patch_interval), (c.rates[1], c.interval)
            source = "photographed" if photographed else "rendered"
            add(c.name, source, count, ours, theirs, (c.difference, c.difference_interval), c.advice)
    simulated = {name: claim for name, claim in promise.controls.items() if name == "bare" or not rows}
    for name, claim in () if photographed else simulated.items():
        points = rates_difference(rate, interval, claim.rate, claim.interval)
        add(name, "simulated", photos, (rate, interval), (claim.rate, claim.interval), points)
    return rows[goal.hardest({name: row.difference_interval for name, row in rows.items()})] if rows else None
