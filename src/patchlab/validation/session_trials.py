"""Count false answers about patches that change nothing: beside photographed controls, from dealt folders, by looks.

In: correlations within a session. Out: by correlation, the shares of trials in which a control of the same rate is
called beaten; in which a promise is called `kept` at the rate just asked for by photographs of few sessions that were
dealt into many folders; and by looking after each session until it fits; each beside the chance with true sessions or
without an effect's limit. Nothing is rendered: photographs are records of counts, times, cameras, light and background.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.study.grid import PositiveInt
from patchlab.study.study import Cell, Result, Study
from patchproof.base.goal import Goal
from patchproof.base.intervals import Estimate, independent_difference, wilson
from patchproof.base.sessions import sessions_difference
from patchproof.base.validation import Share, StrictModel
from patchproof.evidence.grouping import BY_FOLDERS, USUAL_SPREAD, Grouping, merge_folders
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Trace
from patchproof.evidence.verdict import Look, judge, required_rate, watched
from patchproof.optimizer.promise import PROMISE_VIEWS, VIEWS_PER_SESSION
from patchproof.photo.quality import FrameLight
from patchproof.report.tables import Table
from patchproof.sheets.manifest import ConditionClaim, ControlClaim, ModelClaim, Promise, Target

_DEALS = ("one each", "runs of 3", "mixed 5", "true")
_BETWEEN = np.array([0.03, 0.03, 0.6, 0.6, 0.4])  # spread of light and background between sessions of the demo
_PAUSE_S, _PAUSE_FACTOR = 12, 2.5  # median pause between photographs of a session, and its lognormal factor
_MOVE_S, _MOVE_FACTOR = 300, 2.2  # the same between sessions


class SessionTrialsSettings(StrictModel):
    """A promise that might be made, rates and sessions of photographs that might be taken, and numbers of trials."""

    rate: Share = 0.85  # promised rate
    control: Share = 0.3  # the best control's rate
    promises: PositiveInt = 20  # promises drawn for each correlation
    # correlation of two photographs of one session
    correlations: Annotated[tuple[Annotated[Share, Field(le=0.9)], ...], Field(min_length=1)] = (0, 0.05, 0.1, 0.2, 0.3)
    # numbers of sessions that photographs are spread over
    sessions: Annotated[tuple[PositiveInt, ...], Field(min_length=1)] = (2, 3, 4, 6, 8, 12)
    rates: tuple[Share, ...] = (0.05, 0.3, 0.5, 0.8, 0.95)  # of patch and control, which are the same
    effects: tuple[tuple[Share, Share], ...] = ((0.6, 0.3), (0.8, 0.4), (0.9, 0.3))  # rates of patch and control
    trials: PositiveInt = 1000  # of controls, for each correlation, number of sessions and rate
    deals: PositiveInt = 300  # of folders, for each correlation and way to deal


def cells(settings: SessionTrialsSettings, base: Path) -> list[Cell]:
    """A cell per correlation."""
    return [Cell(f"correlation={value:g}", {"correlation": value}) for value in settings.correlations]


def run(settings: SessionTrialsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Run the trials of a correlation; counts by name."""
    rho, rng = cell.values["correlation"], np.random.default_rng(0)
    return {
        "controls": [
            [s, a, b, way, *_control_trials(settings.trials, rho, s, a, b, way, rng)]
            for s in settings.sessions
            for a, b in (*((rate, rate) for rate in settings.rates), *settings.effects)
            for way in ("other", "same", "pairs")
        ],
        "folders": [[d, t, *_folder_trials(settings, rho, d, t, rng)] for d in _DEALS for t in (True, False)],
        "looks": [[way, *_look_trials(settings, rho, way, rng)] for way in ("one look", "each session", "watched")],
    }


def draw_promise(promised: float, of_control: float, correlation: float, rng: np.random.Generator) -> Promise:
    """Draw a promise with as many sessions as real ones, whose rates have that correlation."""
    sessions = PROMISE_VIEWS // VIEWS_PER_SESSION
    rates = _session_rates(rng, promised, max(correlation, 1e-3), (sessions, 1))
    hits = (rng.random((sessions, VIEWS_PER_SESSION)) < rates).ravel()
    rate, whole = float(hits.mean()), (0.0, 1.0)
    control = ControlClaim(
        n=len(hits), rate=of_control, interval=whole, confidence=0, difference=0, difference_interval=(-1, 1)
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


def _session_rates(rng: np.random.Generator, rate: float, rho: float, shape: tuple[int, ...]) -> np.ndarray:
    strength = 1 / rho - 1 if rho else np.inf
    return np.full(shape, rate) if rho == 0 else rng.beta(rate * strength, (1 - rate) * strength, shape)


def _control_trials(trials: int, rho: float, sessions: int, a: float, b: float, way: str, rng) -> tuple[int, int, int]:
    """(trials, patches called better by sessions, by Newcombe's interval of photographs): 3 to 20 photographs each."""
    shown = shown_before = 0
    for _ in range(trials):
        sides: list[dict[int, list[bool]]] = []
        n = rng.integers(3, 21, sessions)
        for i, rate in enumerate((a, b)):
            rates = _session_rates(rng, rate, rho, (sessions,))
            n = n if way == "pairs" else rng.integers(3, 21, sessions)
            first = i * sessions if way == "other" else 0
            sides.append({first + j: list(rng.random(n[j]) < rates[j]) for j in range(sessions)})
        hits = [(sum(map(sum, side.values())), sum(map(len, side.values()))) for side in sides]
        shown += sessions_difference(*sides, paired=way == "pairs")[1][0] > 0
        shown_before += independent_difference(*hits[0], *hits[1])[1][0] > 0
    return trials, int(shown), int(shown_before)


def _folder_trials(settings: SessionTrialsSettings, rho: float, deal: str, timed: bool, rng) -> tuple[float, ...]:
    """(trials, kept as merged, as dealt, by true sessions, mean number of sessions found) of 3 × 20 photographs; "true"
    are 6 × 10 photographs in a folder for each session.
    """
    each, count = (10, 6) if deal == "true" else (20, 3)
    found, kept = [], np.zeros(3, int)
    for _ in range(settings.deals):
        promise = draw_promise(settings.rate, settings.control, rho, rng)
        photos = _records(rng, count, each, timed)
        hits = (rng.random((count, each)) < _session_rates(rng, required_rate(promise), rho, (count, 1))).ravel()
        order = rng.permutation(60) if deal == "mixed 5" else np.arange(60)
        size = {"one each": 1, "runs of 3": 3, "mixed 5": 5, "true": 10}[deal]
        folder = np.empty(60, int)
        folder[order] = np.arange(60) // size
        names = tuple(f"folder {i}" for i in range(60 // size))
        grouping = Grouping((Path(),) * 60, tuple(folder.tolist()), names, BY_FOLDERS)
        merged = merge_folders(grouping, photos).merged
        found.append(len(set(merged)))
        for i, numbers in enumerate((np.array(merged), folder, np.arange(60) // each)):
            sizes = tuple(np.unique(numbers, return_counts=True)[1].tolist())
            kept[i] += judge(int(hits.sum()), sizes, promise).verdict == "kept"
    return settings.deals, *kept.tolist(), float(np.mean(found))


def _records(rng: np.random.Generator, sessions: int, each: int, timed: bool) -> list[MeasuredPhoto]:
    """Photographs of one camera: of measured light and background, and timed if their files say so."""
    photos, minute = [], 0.0
    for session in range(sessions):
        place = rng.normal(0, _BETWEEN)
        minute += float(rng.lognormal(np.log(_MOVE_S), np.log(_MOVE_FACTOR))) / 60
        for i in range(each):
            red, blue, frame_red, frame_blue, level = place + rng.normal(0, USUAL_SPREAD)
            minute += float(rng.lognormal(np.log(_PAUSE_S), np.log(_PAUSE_FACTOR))) / 60 if i else 0
            paper = 0.5 * np.exp([red, 0, blue])
            frame = np.clip(0.25 * np.exp([level + frame_red, level, level + frame_blue]), 1e-3, 4)
            trace = Trace(minute=minute if timed else None, camera="", frame=(frame[0], frame[1], frame[2]))
            entry = PhotoEntry(file=f"{session}/{i}.jpg", status="judged")
            photos.append(MeasuredPhoto(entry, True, light=FrameLight(paper, 0 * paper, 0.5, 0.0), trace=trace))
    return photos


def _look_trials(settings: SessionTrialsSettings, rho: float, way: str, rng) -> tuple[int, ...]:
    """(trials, kept at the first look that says so, kept without a limit of looks): a look after each of up to 12
    sessions of 10 photographs; "watched" after each photograph.
    """
    trials, most, kept, unlimited = 200, 12, 0, 0
    for _ in range(settings.promises):
        promise = draw_promise(settings.rate, settings.control, rho, rng)
        rates = _session_rates(rng, required_rate(promise), rho, (trials, most, 1))
        counts = (rng.random((trials, most, 10)) < rates).reshape(trials, -1).cumsum(1)
        stops = range(1, 10 * most + 1) if way == "watched" else range(10, 10 * most + 1, 10)
        found = np.zeros((2, trials), bool)
        for n in stops if way != "one look" else (10 * 4,):
            sizes = (10,) * (n // 10) + ((n % 10,) if n % 10 else ())
            limit = watched(sizes, promise) if way == "watched" else Look(len(sizes) if way == "each session" else 1)
            for i, look in enumerate((limit, Look())):
                words = np.array([judge(k, sizes, promise, look=look).verdict == "kept" for k in range(n + 1)])
                found[i] |= words[counts[:, n - 1]]
        kept, unlimited = kept + int(found[0].sum()), unlimited + int(found[1].sum())
    return trials * settings.promises, kept, unlimited


def _share(count: float, n: int) -> Estimate:
    return Estimate(count / n, *wilson(round(count), n), n)


def tables(settings: SessionTrialsSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """Shares of trials by correlation."""
    pairs = [(result.cell.values["correlation"], result.answers) for result in results]
    controls = [
        (rho, *row[:4], _share(row[5], row[4]), _share(row[6], row[4]))
        for rho, each in pairs
        for row in each["controls"]
    ]
    folders = [
        (rho, row[0], "yes" if row[1] else "no", *(_share(k, row[2]) for k in row[3:6]), row[6])
        for rho, each in pairs
        for row in each["folders"]
    ]
    look_rows = [(rho, row) for rho, each in pairs for row in each["looks"]]
    looks = [(rho, way, _share(kept, n), _share(unlimited, n)) for rho, (way, n, kept, unlimited) in look_rows]
    head = ("correlation", "sessions", "patch", "control", "sessions of both", "called better", "by photographs")
    about = "3 to 20 photographs a session"
    return (
        Table("controls", "Called better than a photographed control", head, tuple(controls), about),
        Table(
            "folders",
            "Kept at the rate just asked for, from 60 photographs",
            ("correlation", "dealt", "times", "kept", "kept as dealt", "kept by true sessions", "sessions found"),
            tuple(folders),
            "3 sessions of 20 photographs; true: 6 of 10",
        ),
        Table(
            "looks",
            "Kept at the rate just asked for, by looks",
            ("correlation", "looks", "kept", "without a limit"),
            tuple(looks),
            "up to 12 sessions of 10 photographs",
        ),
    )


STUDY = Study("session-trials", SessionTrialsSettings, cells, run, tables)
