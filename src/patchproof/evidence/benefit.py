"""What somebody came for: whether the object is recognized better with the patch than without it; and what to do next.

In: the photographs' rate, photographs of controls or, without any, the controls that the promise simulated. Out:
`Benefit` against the control that is hardest to beat, the bare object first, and a sentence for who cannot tell:

    helps      every control was beaten, at 95 %
    worse      the interval of the difference to that control lies below zero
    no_better  neither; the promise expected no more, or a gain of 10 points is ruled out
    not_shown  neither; the promise expected more, and the photographs rule nothing out

with gain and loss mirrored for `deceive`. The verdict on the promise is another matter: a patch that was promised to be
useless, and is, keeps its promise.
"""

from __future__ import annotations

from collections.abc import Sequence

from patchproof.base.intervals import rates_difference
from patchproof.evidence.results import Benefit, BenefitWord, Control
from patchproof.sheets.manifest import Promise

LITTLE = 0.10  # a gain below which a patch is no better


def benefit_of(
    rate: float, interval: tuple[float, float], controls: Sequence[Control], promise: Promise
) -> Benefit | None:
    """The patch, recognized at that rate, beside its controls; None where there are none."""
    sign, rows = promise.target.goal.sign, []
    for shown in controls:
        if shown.difference is not None and shown.difference_interval is not None:
            rows.append((shown.name, shown.recognized / shown.n, shown.difference, shown.difference_interval))
    photographed = bool(rows)
    for name, claim in () if photographed else promise.controls.items():
        rows.append((name, claim.rate, *rates_difference(rate, interval, claim.rate, claim.interval)))
    if not rows:
        return None

    def gains(row) -> tuple[float, float]:
        low, high = sorted(sign * end for end in row[3])
        return low, high

    unbeaten = [row for row in rows if gains(row)[0] <= 0]
    row = min(unbeaten or rows, key=lambda row: (bool(unbeaten) and row[0] != "bare", gains(row)))
    (low, high), (name, control_rate, difference, ends) = gains(row), row
    word: BenefitWord = "helps" if low > 0 else "worse" if high < 0 else "no_better"
    if word == "no_better" and promise.controls and promise.comparison == "better" and high >= LITTLE:
        word = "not_shown"
    return Benefit(
        word=word,
        goal=promise.target.goal,
        control=name,
        control_rate=control_rate,
        difference=difference,
        difference_interval=ends,
        photographed=photographed,
    )
