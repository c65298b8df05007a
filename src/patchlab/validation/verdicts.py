"""Compute the chances of each verdict at true rates from the promised one downwards.

In: a promised rate, correlations within a session, numbers of sessions that photographs are spread over. Out: the
chances of `kept`, `broken` and `cannot_tell` by correlation, sessions and true rate, which tell the power of the rule
in `evidence.verdict`. Nothing is rendered. Promises are drawn with as many sessions as real ones and judged like them;
the counts' chances at a true rate are exact, and figures are means over promises.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study.grid import PositiveInt
from patchlab.study.study import Cell, Result, Study
from patchproof.base.goal import Goal
from patchproof.base.sessions import RatePosterior, split_evenly
from patchproof.base.validation import Positive, Share, StrictModel
from patchproof.evidence.verdict import judge
from patchproof.optimizer.promise import PROMISE_VIEWS, VIEWS_PER_SESSION
from patchproof.report.tables import Drawing, Table
from patchproof.sheets.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_VERDICTS = ("kept", "cannot_tell", "broken")
_PLOTTED_RATES = 26  # of true rates in the figure


class VerdictsSettings(StrictModel):
    """A promise that might be made, and photographs that might be taken."""

    rate: Share = 0.85  # promised rate
    control: Share = 0.3  # the best control's rate
    # correlation of two photographs of one session
    correlations: Annotated[tuple[Annotated[Positive, Field(le=0.9)], ...], Field(min_length=1)] = (0.02, 0.05, 0.1)
    photos: PositiveInt = 40  # photographs of the print, in all
    # numbers of sessions that photographs are spread over
    sessions: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (1, 2, 4, 8)
    below: tuple[Share, ...] = (0.0, 0.1, 0.15, 0.2)  # how far true rates lie under the promised one
    promises: PositiveInt = 20  # promises drawn for each correlation


def cells(settings: VerdictsSettings, base: Path) -> list[Cell]:
    """A cell per correlation."""
    return [Cell(f"correlation={value:g}", {"correlation": value}) for value in settings.correlations]


def run(settings: VerdictsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """By number of sessions: for each count, the share of promises with each verdict."""
    rng, words = np.random.default_rng(0), {}
    promises = [draw_promise(settings, cell.values["correlation"], rng) for _ in range(settings.promises)]
    for sessions in settings.sessions:
        parts = split_evenly(settings.photos, sessions)
        rows = [[judge(k, parts, promise).verdict for k in range(settings.photos + 1)] for promise in promises]
        words[str(sessions)] = [
            [float(np.mean([word == each for each in of_count])) for word in _VERDICTS]
            for of_count in zip(*rows, strict=True)
        ]
    return words


def draw_promise(settings: VerdictsSettings, correlation: float, rng: np.random.Generator) -> Promise:
    """Draw a promise with as many sessions as real ones, whose rates have that correlation."""
    strength = 1 / correlation - 1
    sessions = PROMISE_VIEWS // VIEWS_PER_SESSION
    rates = rng.beta(settings.rate * strength, (1 - settings.rate) * strength, (sessions, 1))
    hits = (rng.random((sessions, VIEWS_PER_SESSION)) < rates).ravel()
    rate, whole = float(hits.mean()), (0.0, 1.0)
    control = ControlClaim(
        n=len(hits), rate=settings.control, interval=whole, confidence=0, difference=0, difference_interval=(-1, 1)
    )
    unknown = dict.fromkeys(("px_per_mm", "tilt_deg", "azimuth_deg", "contrast", "blur_px"))
    return Promise(
        target=Target(label="", indices=(0,), goal=Goal.assist),
        models=(ModelClaim(name="", sha256=None, rate=rate, interval=whole, confidence=0),),
        rate=rate,
        interval=whole,
        n=len(hits),
        per_session=VIEWS_PER_SESSION,
        controls={"bare": control},
        conditions=tuple(ConditionClaim(recognized=bool(hit), **unknown) for hit in hits),
    )


def _chances(settings: VerdictsSettings, result: Result, sessions: int, rate: float) -> np.ndarray:
    posterior = RatePosterior(np.array([rate]), np.array([result.cell.values["correlation"]]), np.ones(1))
    return posterior.chances(split_evenly(settings.photos, sessions)) @ np.array(result.answers[str(sessions)])


def tables(settings: VerdictsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """The chances by correlation, number of sessions and true rate."""
    rows = tuple(
        (result.cell.values["correlation"], sessions, rate, *map(float, _chances(settings, result, sessions, rate)))
        for result in results
        for sessions in settings.sessions
        for rate in (round(settings.rate - below, 6) for below in settings.below)
    )
    about = (
        f"{settings.photos} photographs, {settings.rate:.0%} promised, the best control at {settings.control:.0%}; "
        f"means over {settings.promises} promises"
    )
    head = ("correlation", "sessions", "true rate", *_VERDICTS)
    return (Table("verdicts", "Chances of verdicts", head, rows, about),)


def figures(settings: VerdictsSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """A plot of the chance of `kept` by true rate, a panel for each correlation."""

    def draw(figure: "Figure") -> None:
        panels = figure.subplots(1, len(results), sharey=True, squeeze=False)[0]
        rates = np.linspace(max(0.01, settings.rate - 0.4), min(0.99, settings.rate + 0.12), _PLOTTED_RATES)
        for axes, result in zip(panels, results, strict=True):
            for sessions in settings.sessions:
                kept = [_chances(settings, result, sessions, float(rate))[0] for rate in rates]
                axes.plot(rates, kept, label=f"{sessions} session{'s' * (sessions > 1)}")
            axes.axvline(settings.rate, color="0.6", linewidth=1)
            axes.set(title=f"correlation {result.cell.values['correlation']:g}", xlabel="true rate", ylim=(0, 1))
        panels[0].set_ylabel(f"chance of kept, {settings.photos} photographs")
        panels[0].legend(fontsize=8)

    about = f"the line is the promised rate, {settings.rate:.0%}"
    return (Drawing("kept", "When promises are called kept", draw, (2.6 * len(results), 3.0), about),)


STUDY = Study("verdicts", VerdictsSettings, cells, run, tables, figures)
