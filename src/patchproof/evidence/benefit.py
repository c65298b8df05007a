"""The verdict on the patch's benefit: is the object recognized better with it than with the hardest control?

In: the photographs' rate, photographs of controls or, without any, the controls that the promise simulated. Out:
`Benefit` against the control that is hardest to beat, the bare object first:

    helps      every control was beaten, at 95 %
    worse      the interval of the difference to that control lies below zero
    no_better  neither; the promise expected no more, or a gain of 10 points is ruled out
    not_shown  neither; such a gain is not ruled out, and the promise expected more or all were taken in one session

with gain and loss mirrored for `deceive`. The verdict on the promise is independent: a patch that was promised to be
useless, and is, keeps its promise.
"""

from collections.abc import Sequence

from patchproof.base.intervals import rates_difference
from patchproof.evidence.results import Benefit, BenefitWord, Control
from patchproof.sheets.manifest import Interval, Promise

LEAST_GAIN = 0.10  # below which a patch is no better


def benefit_of(rate: float, interval: Interval, controls: Sequence[Control], promise: Promise) -> Benefit | None:
    """Compare the patch's rate with its controls'; None if there are none, photographed or promised."""
    sign, rows = promise.target.goal.sign, []
    for control in controls:
        if control.difference is not None and control.difference_interval is not None:
            ends = control.difference_interval
            rows.append((control.name, control.recognized / control.n, control.difference, ends))
    photographed = bool(rows)
    for name, claim in () if photographed else promise.controls.items():
        rows.append((name, claim.rate, *rates_difference(rate, interval, claim.rate, claim.interval)))
    if not rows:
        return None

    def gain_interval(row) -> tuple[float, float]:
        low, high = sorted(sign * end for end in row[3])
        return low, high

    unbeaten = [row for row in rows if gain_interval(row)[0] <= 0]
    row = min(unbeaten or rows, key=lambda row: (bool(unbeaten) and row[0] != "bare", gain_interval(row)))
    (low, high), (name, control_rate, difference, ends) = gain_interval(row), row
    word: BenefitWord = "helps" if low > 0 else "worse" if high < 0 else "no_better"
    advice = next((each.advice for each in controls if each.advice and photographed), "")
    if word == "helps" and advice:
        word = "not_shown"
    if word == "no_better" and (advice or (promise.controls and promise.comparison == "better")) and high >= LEAST_GAIN:
        word = "not_shown"
    return Benefit(
        word=word,
        goal=promise.target.goal,
        control=name,
        control_rate=control_rate,
        difference=difference,
        difference_interval=ends,
        photographed=photographed,
        advice=advice,
    )
