"""Check forecasts of single photographs, and estimated effects against those of photographed controls.

In: settings of `promises`, and a control. Out: for every session of photographs by another renderer, each photograph's
chance as `verify --run` states it beside its answer, and the effect estimated from the photographs beside that with
photographs of the control under the same conditions. Tables by scene: Brier scores,
calibration and interval widths beside the promise's own; bias and coverage of estimated effects.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from patchlab.study.estimates import mean
from patchlab.study.grid import by_scene
from patchlab.study.record import parse_hits
from patchlab.study.study import Cell, Result, Study
from patchlab.validation import photo_sessions
from patchproof.base.intervals import rate, wilson
from patchproof.evidence.forecast import forecast_of
from patchproof.report.tables import Drawing, Table


class ForecastsSettings(photo_sessions.SessionsSettings):
    """Settings of sessions, and the control that is photographed in place of each design."""

    control: Literal["mean", "gray", "noise"] | None = "gray"  # photographed under the same conditions


def run(settings: ForecastsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Record forecasts, estimated effects and photographed effects by session."""
    from patchproof.reprints.photo_forecast import photo_forecaster
    from patchproof.sheets.manifest import load_manifest

    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        patch_run = photo_sessions.make_run_and_sheet(base, cell, folder)
        photos, controls = photo_sessions.take_photos(settings, cell, patch_run, folder), None
        if settings.control is not None:
            controls = photo_sessions.take_photos(settings, cell, patch_run, folder, settings.control)
        forecast, sessions = photo_forecaster(patch_run, load_manifest(folder / "sheet.json")), []
        for name in sorted(path.name for path in photos.iterdir() if path.is_dir()) or [""]:  # one has no folder
            of_control = None if controls is None else controls / name
            report = photo_sessions.verify_photos(photos / name, folder, base, cell, forecast, controls=of_control)
            sessions.append(_record_session(report, settings.control))
    return photo_sessions.record_promise(patch_run) | {"sessions": sessions}


def _record_session(report: Any, control: str | None) -> dict[str, Any]:
    """A session's record from its report; effects are the patch's rate minus the control's."""
    (network, *_), summary = report.summary.models, report.summary
    forecast = [
        (entry.forecast, entry.predictions[network].recognized)
        for entry in report.photos
        if entry.forecast is not None and entry.predictions
    ]
    record: dict[str, Any] = {"forecast": forecast, "agree": None, "estimated": None, "photographed": None}
    if summary.estimated is not None:
        record["agree"] = summary.estimated.agree
        of_control = [claim for claim in summary.estimated.controls if claim.name == control]
        record["estimated"] = [(claim.difference, *claim.difference_interval) for claim in of_control][0:1] or None
    if report.controls:
        record["photographed"] = report.controls[0].difference
    return record


def tables(settings: ForecastsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of forecasts and of effects, by scene and in all, and of every session."""
    groups = by_scene(results) | {"all": list(results)}
    about = f"{settings.sessions} sessions of {settings.photos} photographs of each run"
    head = ("scene", "photographs", "Brier", "Brier of the promise", "calibration slope", "counts held", "width")
    head = (*head, "the promise's width", "the promise's counts held")
    of_photos = [(name, *_forecast_row(group)) for name, group in groups.items()]
    tables_ = [Table("forecasts", "Photographs at their own views", head, tuple(of_photos), about)]
    if settings.control is not None:
        head = ("scene", "sessions", "refused", "photographed effect", "estimated minus photographed", "interval held")
        effects = [(name, *_effect_row(group)) for name, group in groups.items()]
        about = f"{about}; the patch beside {settings.control}"
        tables_.append(Table("effects", "Effects estimated and photographed", head, tuple(effects), about))
    return (*tables_, _session_table(results))


def _forecast_row(group: Sequence[Result]) -> tuple:
    pairs = [pair for result in group for session in result.answers["sessions"] for pair in session["forecast"]]
    if not pairs:
        return (0, *(None,) * 7)
    chances, hits = np.array(pairs, float).T
    held, widths, held_promise, widths_promise, promised = [], [], [], [], []
    for result in group:
        posterior, level = (
            photo_sessions.promise_posterior(result),
            float(np.mean(parse_hits(result.answers["promised"]))),
        )
        for session in result.answers["sessions"]:
            if not session["forecast"]:
                continue
            chances_here, answers = zip(*session["forecast"], strict=True)
            forecast, n = forecast_of(chances_here, answers, level), len(answers)
            low, high = posterior.count_interval((n,))
            held.append(forecast.interval[0] <= forecast.recognized <= forecast.interval[1])
            held_promise.append(low <= forecast.recognized <= high)
            widths.append(np.ptp(forecast.interval) / n)
            widths_promise.append((high - low) / n)
            promised += [(level - answer) ** 2 for answer in answers]
    brier = float(np.mean((chances - hits) ** 2))
    scores = brier, float(np.mean(promised)), calibration_slope(chances, hits)
    middles = float(np.median(widths)), float(np.median(widths_promise))
    return (len(pairs), *scores, rate(held), *middles, rate(held_promise))


def calibration_slope(chances: np.ndarray, hits: np.ndarray) -> float | None:
    """The slope of a logistic regression of answers on the chances' log odds (Cox, Biometrika 45 (1958) 562): 1 if
    chances are calibrated, less if they are overconfident. None if all answers are the same.
    """
    from scipy.optimize import minimize

    if np.ptp(hits) == 0:
        return None
    odds = np.log(chances / (1 - chances))

    def loss(line: np.ndarray) -> float:
        return float(np.mean(np.logaddexp(0, (1 - 2 * hits) * (line[0] + line[1] * odds))))

    return float(minimize(loss, np.array([0.0, 1.0])).x[1])


def _effect_row(group: Sequence[Result]) -> tuple:
    sessions = [session for result in group for session in result.answers["sessions"]]
    refused = [session["estimated"] is None for session in sessions]
    both = [
        (*session["estimated"][0], session["photographed"])
        for session in sessions
        if session["estimated"] is not None and session["photographed"] is not None
    ]
    if not both:
        return len(sessions), rate(refused), None, None, None
    errors = [estimated - photographed for estimated, _, _, photographed in both]
    held = rate([low <= photographed <= high for _, low, high, photographed in both])
    return len(sessions), rate(refused), mean([photographed for *_, photographed in both]), mean(errors), held


def _session_table(results: Sequence[Result]) -> Table:
    head = ("scene", "network", "seed", "session", "photographs", "expected", "recognized", "agree", "estimated")
    rows = []
    for result in results:
        values = result.cell.values
        for number, session in enumerate(result.answers["sessions"], 1):
            chances, hits = zip(*session["forecast"], strict=True) if session["forecast"] else ((), ())
            estimated = session["estimated"][0] if session["estimated"] else (None,) * 3
            start = (values["name"], values["network"], values["seed"], number, len(chances), sum(chances), sum(hits))
            rows.append((*start, session["agree"], *estimated, session["photographed"]))
    head = (*head, "low", "high", "photographed")
    return Table("sessions", "Every session", head, tuple(rows), "effects are of the patch minus the control")


def figures(settings: ForecastsSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """A reliability plot: share recognized by forecast chance."""
    pairs = [pair for result in results for session in result.answers["sessions"] for pair in session["forecast"]]
    if not pairs:
        return ()

    def draw(figure: Any) -> None:
        chances, hits = np.array(pairs, float).T
        axes, edges = figure.subplots(), np.linspace(0, 1, 6)
        number = np.clip(np.digitize(chances, edges) - 1, 0, len(edges) - 2)
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
        for i in sorted(set(number.tolist())):
            some = hits[number == i]
            low, high = wilson(int(some.sum()), len(some))
            span = [[some.mean() - low], [high - some.mean()]]
            axes.errorbar([chances[number == i].mean()], [some.mean()], span, fmt="o", color="tab:blue")
        axes.set(xlabel="chance of the forecast", ylabel="share recognized", xlim=(0, 1), ylim=(0, 1))

    about = f"{len(pairs)} photographs in five groups; bars: 95 %, as if all were independent"
    return (Drawing("reliability", "Forecast and seen", draw, (5.0, 4.5), about),)


STUDY = Study("forecasts", ForecastsSettings, photo_sessions.cells, run, tables, figures)
