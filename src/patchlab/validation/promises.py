"""Check that promised rates hold in independently rendered sessions.

Many runs are promised, printed, photographed by another renderer, and verified.
In: scene files, networks, printers, seeds. Out: for every combination the promised rate and its gain over the best
control, and for each session of its
photographs (one print, one place, light and camera) the promise's interval of counts and the count seen; the share of
intervals that held, their widths beside those of the best possible ones, each scene's bias, and the same for intervals
that treat photographs as independent. Optionally sessions of views by our renderer, and the rate in many other places.
A cell runs a user's commands: optimize, sheet, reprint, verify.

Photographs are path-traced (`path_traced`), since our renderer's would share the promise's errors; with
`path_traced = false` they are ours, which tests only sampling and the page.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study.estimates import mean
from patchlab.study.grid import Names, by_scene, cell_key, short_name
from patchlab.study.record import hits_text, parse_hits
from patchlab.study.study import Cell, Result, Study
from patchlab.validation import photo_sessions
from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate, rate
from patchproof.base.sessions import TAIL, RatePosterior, count_by_session, rate_posterior
from patchproof.base.validation import spelling_hint
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from patchproof.optimizer.run import Run


_MIN_SESSIONS = 20  # fewest sessions for which the best width is estimated


class PromisesSettings(photo_sessions.SessionsSettings):
    """Settings of sessions, and views by our renderer without paper, also in places that the promise does not know."""

    controls: Names = ("bare",)  # what designs are compared with in their promises; all four take most of their time
    rendered: Annotated[int, Field(ge=0, le=1000)] = 0  # sessions of as many views as photographs
    elsewhere: Annotated[int, Field(ge=0, le=100_000)] = 0  # views, each in a place of its own
    # By scene's name: pictures imported in place of optimized designs; if given, other scenes have no runs.
    pictures: dict[str, Names] = Field(default_factory=dict)


def promise_cells(settings: PromisesSettings, base: Path) -> list[Cell]:
    """A cell per combination and picture."""
    optimized = photo_sessions.cells(settings, base)
    if not settings.pictures:
        return optimized
    names = {cell.values["name"] for cell in optimized}
    for name in settings.pictures.keys() - names:
        raise Refused("pictures of the config's scenes", f'"{name}"', spelling_hint(name, names))
    return [
        Cell(f"{short_name(f'/{picture}')}.{cell.name}", {**cell.values, "picture": picture})
        for cell in optimized
        for picture in settings.pictures.get(cell.values["name"], ())
    ]


def run(settings: PromisesSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Promise, photograph and verify one combination."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        patch_run = photo_sessions.make_run_and_sheet(base, cell, folder, controls=settings.controls)
        report = photo_sessions.verify_photos(
            photo_sessions.take_photos(settings, cell, patch_run, folder), folder, base, cell, ledger_photos=0
        )
    sessions = [(session.recognized, session.judged) for session in report.summary.sessions]
    answers = photo_sessions.record_promise(patch_run) | {"sessions": sessions, "verdict": report.summary.verdict}
    claim = patch_run.promise.controls[best := patch_run.promise.best_control]
    answers["gain"] = best, claim.rate, asdict(Estimate(claim.difference, *claim.difference_interval, claim.n))
    return answers | _measure_views(settings, patch_run)


def _measure_views(settings: PromisesSettings, patch_run: "Run") -> dict[str, Any]:
    if not settings.rendered and not settings.elsewhere:
        return {}
    problem, scene, answers = set_problem(patch_run.scene), patch_run.scene, {}
    show = partial(responses, problem, pictures_with_controls(problem, patch_run.design, ()))
    if settings.rendered:
        views = scene.draw("reprint", settings.rendered * settings.photos, per_session=settings.photos)
        hits = show(views)["design"].recognized[0]
        answers["rendered"] = list(zip(*count_by_session(hits, settings.photos), strict=True))
    if settings.elsewhere:
        answers["elsewhere"] = hits_text(show(scene.draw("evaluate", settings.elsewhere))["design"].recognized[0])
    return answers


def tables(settings: PromisesSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Tables of the share of promises that held (photographs, then views), of rates elsewhere, of every session."""
    how = "path-traced photographs" if settings.path_traced else "photographs by our own renderer"
    about = f"{settings.sessions} sessions of {settings.photos} {how} for each promise"
    all_tables = [_share_table("held", "Sessions in which promises held", about, results)]
    if settings.rendered:
        about = f"{settings.rendered} sessions of {settings.photos} views by our own renderer for each promise"
        all_tables.append(_share_table("rendered", "Sessions of views in which promises held", about, results))
    if settings.elsewhere:
        all_tables.append(_elsewhere_table(settings, results))
    return *all_tables, _gain_table(results), _session_table(results)


@dataclass(frozen=True)
class JudgedSession:
    """One session of a run: photographs recognized and judged, and the run's promise."""

    recognized: int
    judged: int
    rate: float
    posterior: RatePosterior
    independent: RatePosterior  # as if photographs were independent

    @property
    def share(self) -> float:
        """The share of judged photographs that were recognized."""
        return self.recognized / self.judged

    def interval(self, independent: bool = False) -> tuple[int, int]:
        """The promise's interval of counts, optionally as if photographs were independent."""
        if independent:
            return self.independent.count_interval((1,) * self.judged)
        return self.posterior.count_interval((self.judged,))

    def held(self, independent: bool = False) -> bool:
        """True if the count lies in that interval."""
        low, high = self.interval(independent)
        return low <= self.recognized <= high


def count_sessions(result: Result, sessions: str = "sessions") -> list[JudgedSession]:
    """A run's sessions of photographs, or of "rendered" views, that have judged photographs."""
    hits = parse_hits(result.answers["promised"])
    about = sum(hits) / len(hits), photo_sessions.promise_posterior(result), rate_posterior(*count_by_session(hits, 1))
    return [JudgedSession(recognized, judged, *about) for recognized, judged in result.answers[sessions] if judged]


def _median_width(sessions: Sequence[JudgedSession], independent: bool = False) -> float:
    return float(np.median([np.ptp(session.interval(independent)) / session.judged for session in sessions]))


def _best_width(sessions: Sequence[JudgedSession]) -> float | None:
    """The distance between the 2.5 and 97.5 % points of shown minus promised rates: the narrowest intervals that hold
    for these sessions. None for too few sessions.
    """
    if len(sessions) < _MIN_SESSIONS:
        return None
    low, high = np.quantile([session.share - session.rate for session in sessions], (TAIL, 1 - TAIL))
    return float(high - low)


def _share_table(name: str, title: str, about: str, results: Sequence[Result]) -> Table:
    kind = "rendered" if name == "rendered" else "sessions"
    rows = []
    for scene, group in (by_scene(results) | {"all": list(results)}).items():
        by_run = [some for result in group if (some := count_sessions(result, kind))]
        sessions = [session for some in by_run for session in some]
        if not sessions:
            continue
        rows.append(
            (
                scene,
                rate([session.held() for session in sessions]),
                _median_width(sessions),
                _best_width(sessions),
                rate([session.held(independent=True) for session in sessions]),
                _median_width(sessions, independent=True),
                mean([float(np.mean([session.share - session.rate for session in some])) for some in by_run]),
            )
        )
    about = (
        f"{about}; widths: medians, as a share of the photographs; best: between the ends of what sessions showed; "
        "bias: recognized minus promised rate, over runs"
    )
    head = ("scene", "held", "width", "best width", "held, if independent", "width, if independent", "bias")
    return Table(name, title, head, tuple(rows), about)


def _session_table(results: Sequence[Result]) -> Table:
    head = ("scene", "network", "printer", "seed", "design", "session", "promised", "correlation")
    head = (*head, "judged", "recognized", "low", "high", "held", "verdict")
    rows = []
    for result in results:
        values, printer = result.cell.values, short_name(result.cell.values["scene"]["printer"]["profile"])
        for number, session in enumerate(count_sessions(result), 1):
            design = short_name(f"/{values['picture']}") if "picture" in values else "own"
            start = (values["name"], values["network"], printer, values["seed"], design, number)
            what = (session.rate, session.posterior.correlation[0], session.judged, session.recognized)
            rows.append((*start, *what, *session.interval(), session.held(), result.answers["verdict"]))
    return Table("promises", "Every session", head, tuple(rows), "the verdict is that of all sessions of the run")


def _gain_table(results: Sequence[Result]) -> Table:
    rows = []
    for result in results:
        promised, (control, beside, gain) = parse_hits(result.answers["promised"]), result.answers["gain"]
        rows.append((*cell_key(result), sum(promised) / len(promised), control, beside, Estimate(**gain)))
    head = ("scene", "network", "seed", "promised", "best control", "its rate", "gain")
    return Table("gains", "Gains over the best control", head, tuple(rows), "a lower rate is the gain where one hides")


def _elsewhere_table(settings: PromisesSettings, results: Sequence[Result]) -> Table:
    rows = []
    for result in results:
        values, (low, high) = result.cell.values, photo_sessions.promise_posterior(result).rate_interval
        shown, promised = rate(parse_hits(result.answers["elsewhere"])), parse_hits(result.answers["promised"])
        within = shown is not None and low <= shown.value <= high
        about = (values["name"], values["network"], values["seed"])
        rows.append((*about, sum(promised) / len(promised), low, high, shown, within))
    head = ("scene", "network", "seed", "promised", "low", "high", "elsewhere", "within")
    about = f"{settings.elsewhere} views by our own renderer, each in another place that the promise does not know"
    return Table("elsewhere", "Rates elsewhere within the promised interval", head, tuple(rows), about)


def figures(settings: PromisesSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """A plot of the share recognized in each session against the promised rate."""

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color="0.6", linewidth=1)
        for name, group in by_scene(results).items():
            sessions = [session for result in group for session in count_sessions(result)]
            if not sessions:
                continue
            promised = [session.rate for session in sessions]
            low, high = np.array([np.array(session.interval()) / session.judged for session in sessions]).T
            (line,) = axes.plot(promised, [session.share for session in sessions], "o", label=name, markersize=4)
            axes.vlines(promised, low, high, colors=line.get_color(), alpha=0.2, linewidth=3)
        axes.set(xlabel="promised rate", ylabel="share recognized in a session", xlim=(0, 1.02), ylim=(-0.02, 1.04))
        axes.legend(loc="upper left", fontsize=8)

    about = "points: what sessions showed; bars: the promises' 95 % prediction intervals"
    return (Drawing("calibration", "Promised and seen", draw, (6.0, 5.0), about),)


STUDY = Study("promises", PromisesSettings, promise_cells, run, tables, figures)
