"""From counts to a verdict: pure functions, no photographs.

In: how many photographs were recognized, what was promised, what controls showed. Out: `kept`, `broken` or
`cannot_tell` with the prediction interval that decided it, and whether an effect was shown. For `assist`:

    broken       k < k_lo                             fewer than the promise allows for, at 95 %
    kept         k ≥ k_lo and k_lo / n ≥ rate - 0.20  and enough photographs that a miss would have shown
    cannot_tell  otherwise; always below 5 judged photographs, or with more than 10 % of readable ones without a marker

mirrored for `deceive`, where a rate too high breaks the promise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from patchproof.claims import (
    CONFIDENCE,
    independent_difference,
    mcnemar_p,
    paired_difference,
    prediction_interval,
    wilson,
)
from patchproof.evidence.results import Control, Effect, Word
from patchproof.goal import Goal

LEAST_JUDGED = 5
MOST_WITHOUT_MARKERS = 0.10
SLACK = 0.20  # how far below the promised rate the interval's floor may lie
LEAST_PAIRS = 5  # fewer pairs can never reach 5 % in McNemar's test; the unpaired interval is used then


@dataclass(frozen=True)
class Verdict:
    """The word, the counts that the promise allows, and one sentence with the figures that decided it."""

    verdict: Word
    prediction_interval: tuple[int, int] | None
    reason: str


def judge(
    recognized: int, judged: int, promise_rate: float, promise_n: int, goal: Goal, without_markers: int
) -> Verdict:
    """The verdict on `recognized` of `judged` photos; `without_markers` more are readable and show no marker."""
    if judged == 0:
        return Verdict("cannot_tell", None, "No photograph could be judged.")
    low, high = prediction_interval(round(promise_rate * promise_n), promise_n, judged)
    counts = f"{recognized} of {judged} photographs were recognized; the promise allows for {low} to {high}"
    lost = without_markers / (judged + without_markers)
    if lost > MOST_WITHOUT_MARKERS:
        reason = f"{without_markers} readable photographs show no marker ({lost:.0%}, at most 10 % are allowed)."
        return Verdict("cannot_tell", (low, high), reason)
    if judged < LEAST_JUDGED:
        return Verdict("cannot_tell", (low, high), f"Only {judged} photographs could be judged; at least 5 are needed.")
    worst = low if goal.sign > 0 else high
    if goal.sign * (recognized - worst) < 0:
        return Verdict("broken", (low, high), f"{counts}.")
    if goal.sign * (worst / judged - promise_rate) >= -SLACK - 1e-9:
        return Verdict("kept", (low, high), f"{counts}.")
    return Verdict("cannot_tell", (low, high), f"{counts}, which is too wide to tell: take more photographs.")


def compare(patch: Mapping[str, bool], name: str, control: Mapping[str, bool], goal: Goal) -> Control:
    """Whether the patch changes recognition in the goal's direction; answers by file name, equal names are pairs."""
    counts = sum(control.values()), len(control)
    beside = Control(name, *counts, wilson(*counts))
    if not patch or not control:
        return beside
    names = sorted(patch.keys() & control.keys())
    if len(names) >= LEAST_PAIRS:
        a, b = [patch[name] for name in names], [control[name] for name in names]
        difference, interval = paired_difference(a, b)
        p_value = mcnemar_p(a, b)
        shown = p_value < 1 - CONFIDENCE and goal.sign * difference > 0
        pairs = len(names)
    else:
        difference, interval = independent_difference(sum(patch.values()), len(patch), *counts)
        shown, p_value, pairs = min(goal.sign * end for end in interval) > 0, None, 0
    return replace(
        beside, pairs=pairs, difference=difference, difference_interval=interval, p_value=p_value, shown=shown
    )


def effect_of(controls: Sequence[Control]) -> Effect:
    """`shown` only where every control was beaten; controls without a judged photograph are not tests."""
    answers = [control.shown for control in controls if control.shown is not None]
    if not answers:
        return "not_tested"
    return "shown" if all(answers) else "not_shown"
