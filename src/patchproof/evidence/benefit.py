"""Does the patch help? One comparison answers it: that with the hardest control, by the strongest evidence there is.

In: photographs of controls, the effect estimated from the patch's photographs, the promise. Out: `Benefit`, which the
headline, the page and `--require helps` all use. Photographed controls decide alone, if there are any. Else those
decide that were rendered into the patch's own photographs, with the bare object as the promise simulated it, since the
paper hides it. Else it is the promise's controls. The patch has to beat all that decide; which one is named, and which
of the three answers it gives, says `base.goal`.

The verdict on the promise is independent: a patch that was promised to be useless, and is, keeps its promise.
"""

from collections.abc import Sequence

from patchproof.base.intervals import rates_difference
from patchproof.evidence.results import Benefit, Control, ControlSource, EffectEstimate
from patchproof.sheets.manifest import Interval, Promise

Rate = tuple[float, tuple[float, float]]  # with its interval


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
