"""Tables and figures of an operating envelope: breaking points, points of sweeps, codes beyond them.

In: finished cells. Out: tables, and a page to print beside the patch. Breaking points are values of their axis; one
beyond the sweep is called “holds”, and an interval that ends at the sweep's end is open there. A design breaks where it
stops gaining over its controls, whatever label the network gives beyond.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np

from patchlab.study.figures import EMPTY_COLOR
from patchlab.validation.envelope.axes import AXES
from patchlab.validation.envelope.fit import (
    BEYOND_SWEEP,
    CONTROLS,
    MAX_P_NOT_MONOTONE,
    MIN_LOST_SHARE,
    gains_over_controls,
    has_effect,
)
from patchproof.base.goal import Goal
from patchproof.base.intervals import Estimate, rate
from patchproof.report.tables import Drawing, Table, Value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from patchlab.study.study import Result

STAGES = {"gains": "design gains", "found": "sheet found", "measured": "measured"}
_COLORS = {"gains": "#2a6f97", "found": "#e09f3e", "measured": "#2a9d6f"}
_RATE_HEADINGS = ("recognized", *CONTROLS, "gain", "effect", "sheet found", "measured")
EndValues = Mapping[str, Any]  # a cell's axis with both ends
BreakValues = Mapping[str, Any]  # a stage's `Break` in its answers
HOLDS, NEVER, EFFECT, NO_EFFECT = "holds", "never worked", "gains", "no gain shown"
_CONTROL = "the better of the bare object and a gray piece in the same markers, on the same conditions"
_PAGE_IN = (11.69, 8.27)  # A4, landscape


def tables(settings: Any, results: "Sequence[Result]") -> Sequence[Table]:
    """Tables of breaking points, codes beyond them, points of sweeps."""
    ends = ("axis", "unit", "easy", "hard")
    all_tables = (
        Table(
            "breaks",
            "Breaking points",
            (*ends, *STAGES.values(), "not monotone", f"{NO_EFFECT} at"),
            tuple(_break_row(result) for result in results),
            f"The design gains up to where it does no more than {_CONTROL}: the last point at which the 95 % interval "
            "of the difference lies above 0, and the first at which it does not. For the sheet, where a fitted falling "
            "curve has lost half of what it loses over the sweep: median of the bootstrap over conditions, 95 % "
            f"interval; “{HOLDS}”: it loses less than {MIN_LOST_SHARE:.0%} of its rate. n conditions: {settings.n} "
            f"shown to the network (a quarter where JPEG is varied), {settings.photos} photographed.",
        ),
        Table(
            "beyond",
            "What the tool says beyond",
            ("axis", "photographs", "measured all the same", "said of the others"),
            tuple(_beyond_row(result) for result in results),
            "Photographs at points harder than the breaking point of measuring, or at the hardest point.",
        ),
        Table(
            "sweeps",
            "All points",
            ("axis", "value", *_RATE_HEADINGS, "median error mm", "largest error mm", "said"),
            tuple(row for result in results for row in _point_rows(result)),
            f"Gain: over {_CONTROL} (Newcombe). “{NO_EFFECT}”: its interval holds 0. Errors are the largest "
            "of the design's four corners, against the simulation's truth, of flat sheets. Intervals: Wilson.",
        ),
    )
    return tuple(table for table in all_tables if table.rows)


def figures(settings: Any, results: "Sequence[Result]") -> Sequence[Drawing]:
    """The operating envelope as one page to print."""
    page = Drawing(
        "page",
        "Operating envelope",
        lambda figure: _draw_page(figure, results),
        _PAGE_IN,
        f"The design gains where it does better than {_CONTROL} (95 %); beyond, no gain is shown, whatever the "
        "network answers. Beside its bar: the last point with a gain and the first without, in brackets the gains "
        "at both ends. Bars of the sheet run to where half of what the sweep takes is lost; whiskers: 95 % intervals; "
        "→: it holds; !: not monotone; in brackets the fitted rates at both ends.",
    )
    return (page,)


def found_and_measured(answers: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """By stage of the sheet P×N bool: the sheet was found, it was measured."""
    status = np.array(answers["status"])
    return {"found": status != "rejected", "measured": status == "measured"}


def gains_in(answers: Mapping[str, Any]) -> list[Estimate]:
    """Per point the design's gain over the better control."""
    controls = {kind: np.array(hits, bool) for kind, hits in answers["controls"].items()}
    return gains_over_controls(np.array(answers["recognized"], bool), controls)


def _break_row(result: "Result") -> tuple[Value, ...]:
    x, answers = result.cell.values["x"], result.answers
    axis, breaks = AXES[x["axis"]], answers["breaks"]
    rising = [f"{STAGES[name]} (p = {b['monotone_p']:.3f})" for name, b in breaks.items() if _is_not_monotone(b)]
    shown, photographed = len(answers["recognized"][0]), len(answers["status"][0])
    values = [_break_value(x, breaks[name], shown if name == "gains" else photographed) for name in STAGES]
    gains = zip(answers["points"], gains_in(answers), strict=True)
    without = [_short_number(point[x["axis"]]) for point, gain in gains if not has_effect(gain)]
    return axis.title, axis.unit, x["easy"], x["hard"], *values, ", ".join(rising), ", ".join(without)


def _is_not_monotone(break_: BreakValues) -> bool:
    return break_["monotone_p"] is not None and break_["monotone_p"] < MAX_P_NOT_MONOTONE


def _break_value(x: EndValues, break_: BreakValues, n: int) -> Value:
    if break_["value"] is None:
        return NO_EFFECT if break_["monotone_p"] is None else NEVER
    if break_["value"] >= BEYOND_SWEEP:
        return HOLDS
    ends = [_axis_value(x, break_[name]) for name in ("low", "high")]
    return Estimate(_axis_value(x, break_["value"]), min(ends), max(ends), n)


def _axis_value(x: EndValues, position: float) -> float:
    return AXES[x["axis"]].value(x["easy"], x["hard"], min(position, 1.0))


def _beyond_row(result: "Result") -> tuple[Value, ...]:
    x, answers = result.cell.values["x"], result.answers
    where = answers["breaks"]["measured"]["value"]
    positions = np.linspace(0, 1, x["points"])
    beyond = [i for i in range(x["points"]) if where is None or positions[i] > min(where, 1 - 1e-9)]
    photos = [photo for i in beyond for photo in zip(answers["status"][i], answers["code"][i], strict=True)]
    status, codes = [status for status, _ in photos], [code for status, code in photos if status != "measured"]
    return AXES[x["axis"]].title, len(status), status.count("measured"), _count_codes(codes)


def _count_codes(codes: Sequence[str | None]) -> str:
    return ", ".join(f"{code} {count}" for code, count in Counter(code for code in codes if code).most_common())


def _point_rows(result: "Result") -> list[tuple[Value, ...]]:
    name, answers = result.cell.values["x"]["axis"], result.answers
    rows = []
    for i, (point, rates) in enumerate(zip(answers["points"], _rates(answers), strict=True)):
        errors = [e for e in answers["error_mm"][i] if e is not None]
        median, largest = (float(np.median(errors)), max(errors)) if errors else (None, None)
        rows.append((AXES[name].title, point[name], *rates, median, largest, _count_codes(answers["code"][i])))
    return rows


def _rates(answers: Mapping[str, Any]) -> list[tuple[Value, ...]]:
    shown = [answers["recognized"], *(answers["controls"][kind] for kind in CONTROLS)]
    sheet = found_and_measured(answers).values()
    return [
        (
            *(rate(hits[i]) for hits in shown),
            gain,
            EFFECT if has_effect(gain) else NO_EFFECT,
            *(rate(hits[i].tolist()) for hits in sheet),
        )
        for i, gain in enumerate(gains_in(answers))
    ]


def _draw_page(figure: "Figure", sweeps: "Sequence[Result]") -> None:
    first = sweeps[0].answers
    goal = "seen as" if Goal(first["goal"]).sign > 0 else "not seen as"
    figure.suptitle(f"Operating envelope of sheet {first['sheet']}: {goal} {first['label']} by {first['model']}")
    _draw_bars(figure.add_subplot(), sweeps)


def _draw_bars(axes: "Axes", sweeps: "Sequence[Result]") -> None:
    for row, result in enumerate(sweeps):
        x = result.cell.values["x"]
        for k, (stage, color) in enumerate(_COLORS.items()):
            label, y = None if row else STAGES[stage], row + 0.24 * (k - 1)
            if stage == "gains":
                _draw_without(axes, y, [has_effect(gain) for gain in gains_in(result.answers)], color)
            _draw_bar(axes, y, x, result.answers["breaks"][stage], color, label)
        axis = AXES[x["axis"]]
        axes.text(-0.02, row, f"{axis.title}\n{axis.unit}", ha="right", va="center", fontsize=7.5)
        axes.text(0.0, row + 0.46, _short_number(x["easy"]), ha="left", va="center", fontsize=6, alpha=0.7)
        axes.text(1.0, row + 0.46, _short_number(x["hard"]), ha="right", va="center", fontsize=6, alpha=0.7)
    axes.set_xlim(-0.3, 1.3)
    axes.set_ylim(len(sweeps) - 0.3, -0.7)
    axes.set_axis_off()
    axes.legend(ncols=3, loc="upper center", bbox_to_anchor=(0.55, 1.04), frameon=False, fontsize=8)


def _draw_without(axes: "Axes", y: float, gains: Sequence[bool], color: str) -> None:
    """Draw where the design has no effect beyond its breaking point, and where it gains again."""
    ends = [0.0, *((np.arange(len(gains) - 1) + 0.5) / (len(gains) - 1)).tolist(), 1.0]  # half way between the points
    for gaining, run in groupby(range(len(gains)), lambda i: gains[i]):
        left, *_, right = (ends[i] for point in run for i in (point, point + 1))
        if not gaining:
            axes.barh(y, right - left, left=left, height=0.2, color=EMPTY_COLOR)
            axes.text((left + right) / 2, y, NO_EFFECT, ha="center", va="center", fontsize=5.5)
        elif left:
            axes.barh(y, right - left, left=left, height=0.2, color=color, alpha=0.75)


def _draw_bar(axes: "Axes", y: float, x: EndValues, break_: BreakValues, color: str, label: str | None) -> None:
    value, low, high = (break_[name] for name in ("value", "low", "high"))
    axes.barh(y, min(value or 0.0, 1.0), height=0.2, color=color, alpha=0.75, label=label)
    of_sheet = break_["monotone_p"] is not None
    if value is None:
        axes.text(0.01, y, NEVER if of_sheet else "", va="center", fontsize=6.5)
        return
    if value >= BEYOND_SWEEP:
        axes.text(1.01, y, "→", va="center", fontsize=8, color=color)
        return
    first, last = break_["rates"]
    where, end = f"{_short_number(_axis_value(x, low))} to {_short_number(_axis_value(x, high))}", 1.0
    if of_sheet:
        where, end = _short_number(_axis_value(x, value)), min(high, 1.0)
        axes.plot([low, end], [y, y], color="black", linewidth=0.9)
    text = f"{where} ({first:.2f}, {last:.2f})" + (" !" if _is_not_monotone(break_) else "")
    axes.text(end + 0.01, y, text, va="center", fontsize=6.5)


def _short_number(value: float) -> str:
    return f"{value:.2g}" if abs(value) < 100 else f"{value:.0f}"
