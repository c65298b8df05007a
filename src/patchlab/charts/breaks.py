"""Chart where each method breaks: the last good and the first bad point along an axis, and the code that is said there.

In: the demo's scene, and nothing of a run: the sheet's design is noise, printed as promised. A cell is one method along
one axis, from easy to hard, all else easy; photographs by our renderer are measured as `verify` does and held against
the renderer's truth, verdicts and promises against sessions drawn at a known rate. A point is good where `MIN_SHARE` of
its trials are, of promises `MIN_COVERAGE`. Out: both points, the most frequent code of the bad trials, and how many of
them nothing was said about. A cell ends at the second bad point.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import torch

from patchlab.charts.bars import BAR_HEAD, ROW_IN, Bar, BarPoint, draw_bars, said_text
from patchlab.study.grid import PositiveInt
from patchlab.study.record import corner_error_mm
from patchlab.study.study import Cell, Result, Study
from patchlab.validation.envelope.axes import conditions_at, scene_at
from patchlab.validation.mounted_sheets import mount_content
from patchlab.validation.session_trials import draw_promise
from patchproof.app.demo import SCENE
from patchproof.base.geometry import fit_homography, local_scale, rect_corners
from patchproof.base.output import image_pixels
from patchproof.base.sessions import count_by_session, rate_posterior, split_evenly
from patchproof.base.validation import StrictModel
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.results import PhotoEntry
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.evidence.task import promised_ranges
from patchproof.evidence.verdict import judge
from patchproof.photo.read import Photo
from patchproof.render.photograph import photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.report.tables import Drawing, Table
from patchproof.reprints.reprint import MountedSheet, jpeg_of
from patchproof.scene.conditions import with_values
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.scene.scene import load_scene
from patchproof.sheets.content import SheetContent
from patchproof.sheets.piece import control_design

MIN_SHARE, MIN_COVERAGE = 0.8, 0.9  # of trials; of promises, whose intervals are 95 %
MAX_DELTA_E = 4.0  # mean ΔE00 of a print that is as promised, after the fit of its light
_EASY = {"tilt": 20.0, "module_px": 5.0, "blur": 0.1, "noise": 0.005, "darkness": 0.0, "jpeg": 95.0}
_PHOTO_PX = (800, 600)
_TAPE_SRGB = 0.45  # color of the tape that hides a part of the piece
_RATE, _CONTROL_RATE, _CORRELATION = 0.85, 0.3, 0.05  # of promises
_SESSIONS, _PER_SESSION = 8, 12  # of photographs of their prints


class BreaksSettings(StrictModel):
    """Numbers of trials at each point."""

    photos: PositiveInt = 12  # photographs
    draws: PositiveInt = 200  # promises


class Trial(NamedTuple):
    """Whether one trial came out right, and the code or word that was said otherwise."""

    good: bool
    said: str | None


@dataclass(frozen=True)
class Probe:
    """An axis: values from easy to hard, and the trials of each method at a value, by number."""

    axis: str
    values: tuple[float, ...]
    trials: Callable[[float, int], Mapping[str, Trial]]
    drawn: bool = False  # its trials are verdicts or promises, not photographs
    share: float = MIN_SHARE  # of good trials at a good point


class MeasuredShot(NamedTuple):
    """A measured photograph, the largest corner error in mm (None: unrolled or none), and the true tilt in degrees."""

    entry: PhotoEntry
    error_mm: float | None
    tilt_deg: float
    distance_mm: float


@lru_cache(maxsize=1)
def _sheet() -> tuple[MountedSheet, PatchScene]:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "scene.toml"
        path.write_text(SCENE.replace("[camera]", f"[camera]\nphoto_px = {list(_PHOTO_PX)}"), encoding="utf-8")
        scene = require_patch(load_scene(path, 0))
    (width, height), piece = scene.piece.size_mm, scene.piece
    blank = np.zeros((240, round(240 * width / height), 3), np.uint8)
    noise = control_design("noise", blank, scene.sheet_id, piece)
    return mount_content(set_stage(scene), SheetContent(piece, scene.sheet_id, "design", noise)), scene


@lru_cache(maxsize=2)
def _stage_at(radius_mm: float | None) -> Stage:
    return set_stage(scene_at(_sheet()[1], {} if radius_mm is None else {"curl": radius_mm}))


def _piece_under_tape(share: float) -> PiecePicture:
    """The printed piece with so large a share of its width, from the left, under tape."""
    sheet, _ = _sheet()
    srgb = sheet.printed(sheet.printer.apply).srgb
    srgb[:, : round(share * srgb.shape[1])] = _TAPE_SRGB
    return PiecePicture.of(srgb)


def _shoot(axis: str, values: Mapping[str, float], number: int) -> MeasuredShot:
    (sheet, scene), point, value = _sheet(), {**_EASY, **values}, values[axis]
    stage = _stage_at(value * scene.piece.size_mm[0] if axis == "curl" else None)
    point["blur"] *= point["module_px"]
    point["darkness"] -= point.pop("brightness", 0)
    point["distance"] = scene.focal_px * scene.piece.module_mm / point.pop("module_px")
    drawn = conditions_at(scene.draw("reprint", 1, 0, number), point)
    balance = drawn.sensor.white_balance * (np.array([value, 1, 1 / value]) ** 0.5 if axis == "cast" else 1)
    drawn = with_values(drawn, white_balance=balance, dot_gain=0.0, density=0.0, mottle=0.0)
    piece = _piece_under_tape(value) if axis == "hidden" else sheet.piece
    with torch.no_grad():
        srgb = image_pixels(jpeg_of(photograph(stage, piece, drawn, scene.photo_px, jpeg=False), drawn))
    surface = surface_of(sheet.manifest)
    view = pinhole_photo(Photo(srgb, float(scene.matrix_px(scene.photo_px)[0, 0])), None)
    promised = promised_of(sheet.manifest, surface, sheet.printer)
    entry = measure(view, "photo", surface, promised, promised_ranges(()), with_pictures=False).entry
    corners, placed = rect_corners(surface.rect_mm), require_patch(stage.scene)
    true_px = placed.piece_px(drawn, corners - sheet.manifest.cut_mm[:2])
    error = corner_error_mm(entry.geometry, corners, true_px) if entry.geometry else None
    _, tilt_deg = local_scale(fit_homography(corners, true_px), surface.center_mm)
    middle_mm = placed.camera_from_print(drawn)[0] @ [*placed.placement.center_mm, 1]
    return MeasuredShot(entry, error, tilt_deg, float(np.linalg.norm(middle_mm[:3])))


def _found(shot: MeasuredShot) -> Trial:
    return Trial(shot.entry.status != "rejected", shot.entry.code)


def _rectified(shot: MeasuredShot) -> Trial:
    geometry, measured = shot.entry.geometry, shot.entry.status == "measured"
    right = shot.error_mm is None or (geometry is not None and shot.error_mm <= 3 * geometry.corner_uncertainty_mm)
    return Trial(measured and right, None if measured else shot.entry.code)


def _placed(shot: MeasuredShot) -> Trial:
    """The tilt within three times its uncertainty, and a distance within 3 % or three times its own."""
    geometry, pose = shot.entry.geometry, shot.entry.pose
    if geometry is None or geometry.tilt_deg is None or pose is None or pose.distance_mm is None:
        return Trial(False, shot.entry.code or (geometry and f"focal {geometry.focal}"))
    near = abs(pose.distance_mm - shot.distance_mm) <= max(
        0.03 * shot.distance_mm, 3 * (pose.distance_uncertainty_mm or 0)
    )
    upright = abs(geometry.tilt_deg - shot.tilt_deg) <= 3 * (geometry.tilt_uncertainty_deg or 0) + 2
    return Trial(near and upright, shot.entry.code)


def _colored(shot: MeasuredShot) -> Trial:
    color = shot.entry.color
    right = color is not None and color.delta_e00_mean is not None and color.delta_e00_mean <= MAX_DELTA_E
    return Trial(right and shot.entry.status == "measured", shot.entry.code)


def _kept(number: int, sessions: float = _SESSIONS, below: float = 0.0) -> Trial:
    """Photographs of a print whose rate is so far `below` its promise are called kept."""
    rng, strength = np.random.default_rng([number, 1]), 1 / _CORRELATION - 1
    promise = draw_promise(_RATE, _CONTROL_RATE, _CORRELATION, rng)
    parts, true = split_evenly(_SESSIONS * _PER_SESSION, round(sessions)), _RATE - below
    counts = rng.binomial(parts, rng.beta(true * strength, (1 - true) * strength, len(parts)))
    word = judge(int(counts.sum()), parts, promise).verdict
    return Trial(word == "kept", None if word == "kept" else word)


def _covers(number: int, sessions: float = 100, copies: int = 1, moved: float = 0.0) -> Trial:
    """A promise's interval holds the count of eight new sessions; its own draws may be copies, places may differ."""
    rng, strength = np.random.default_rng([number, 2]), 1 / _CORRELATION - 1
    rates = rng.beta(_RATE * strength, (1 - _RATE) * strength, (max(round(sessions) // copies, 1), 1))
    hits = np.repeat(rng.random((len(rates), 4)) < rates, copies, 0).ravel()
    low, high = rate_posterior(*count_by_session(hits.tolist(), 4)).count_interval((_PER_SESSION,) * _SESSIONS)
    true = _RATE - moved
    seen = rng.binomial(_PER_SESSION, rng.beta(true * strength, (1 - true) * strength, _SESSIONS)).sum()
    return Trial(bool(low <= seen <= high), "broken" if seen < low else None)


_CHECKS = {"markers": _found, "rectification": _rectified, "pose": _placed, "color": _colored, "light fit": _colored}
_ORDER = [*_CHECKS, "verdict", "promise"]  # of methods in tables


def _photographed(axis: str, key: str, values: tuple[float, ...], *methods: str, **easy: float) -> Probe:
    def trials(value: float, number: int) -> dict[str, Trial]:
        shot = _shoot(key, {**easy, key: value}, number)
        return {method: _CHECKS[method](shot) for method in methods}

    return Probe(axis, values, trials)


PROBES = (
    _photographed(
        "distance, px per module", "module_px", (5, 3.5, 2.5, 2, 1.7, 1.4, 1.2, 1, 0.8), "markers", "rectification"
    ),
    _photographed("distance, px per module", "module_px", (5, 3.5, 2.5, 2, 1.7, 1.4, 1.2), "pose", tilt=50.0),
    _photographed("tilt, °", "tilt", (0, 30, 50, 60, 66, 72, 76, 80, 84), "markers", "rectification"),
    _photographed("tilt, ° (from the side to square)", "tilt", (60, 50, 40, 30, 20, 10), "pose", module_px=4.0),
    _photographed("blur, modules (sigma)", "blur", (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1), "markers", "rectification"),
    _photographed("hidden share", "hidden", (0, 0.1, 0.2, 0.3, 0.6, 0.8, 0.9, 1), "markers", "rectification"),
    _photographed("curl, radius in widths", "curl", (100, 50, 25, 12, 6, 3, 1.5, 0.8, 0.4), "rectification"),
    _photographed("darkness, stops", "darkness", (0, 2, 3, 4, 5, 6, 7, 8), "markers", "light fit"),
    _photographed("overexposure, stops", "brightness", (0, 1, 1.5, 2, 2.5, 3, 4), "color"),
    _photographed("noise, of white", "noise", (0.005, 0.02, 0.05, 0.1, 0.2, 0.4), "markers", "color"),
    _photographed("cast, red over blue", "cast", (1, 2, 4, 8, 16, 32, 64), "light fit"),
    Probe("sessions of 96 photographs", (12, 8, 6, 4, 3, 2, 1), lambda v, i: {"verdict": _kept(i, v)}, True),
    Probe(
        "points under the promise", (0, 3, 6, 9, 12, 16, 20), lambda v, i: {"verdict": _kept(i, below=v / 100)}, True
    ),
    Probe("sessions behind it", (100, 50, 25, 12, 6, 3), lambda v, i: {"promise": _covers(i, v)}, True, MIN_COVERAGE),
    Probe(
        "copies of each session",
        (1, 2, 4, 8, 16),
        lambda v, i: {"promise": _covers(i, copies=int(v))},
        True,
        MIN_COVERAGE,
    ),
    Probe(
        "places off by, points",
        (0, 3, 6, 9, 12, 16),
        lambda v, i: {"promise": _covers(i, moved=v / 100)},
        True,
        MIN_COVERAGE,
    ),
)


def cells(settings: BreaksSettings, base: Path) -> list[Cell]:
    """A cell per axis: methods that share it see the same photographs."""
    return [Cell(f"{i:02d}", {"axis": probe.axis, "values": probe.values}) for i, probe in enumerate(PROBES)]


def run(settings: BreaksSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Walk from easy to hard until each method has two bad points; by method and value the number of good trials, of
    silent bad ones, and what was said of the others.
    """
    probe, points = PROBES[int(cell.name)], {}
    count = settings.draws if probe.drawn else settings.photos
    for value in probe.values:
        trials = [probe.trials(value, number) for number in range(count)]
        for method in trials[0]:
            bad = [trial[method].said for trial in trials if not trial[method].good]
            said = Counter(code for code in bad if code).most_common()
            point = {"value": value, "good": count - len(bad), "silent": bad.count(None), "said": said}
            points.setdefault(method, []).append(point)
        if all(sum(p["good"] < probe.share * count for p in some) >= 2 for some in points.values()):
            break
    return {"n": count, "share": probe.share, "points": points}


def _bars(results: Sequence[Result]) -> list[Bar]:
    """All bars, those of a method together."""
    bars = []
    for result in results:
        axis, values, n = *(result.cell.values[key] for key in ("axis", "values")), result.answers["n"]
        for method, points in result.answers["points"].items():
            tried = [BarPoint(p["good"] >= result.answers["share"] * n, p["said"], p["silent"]) for p in points]
            bars.append(Bar(method, axis, values, tried, n))
    return sorted(bars, key=lambda bar: _ORDER.index(bar.method))


def tables(settings: BreaksSettings, results: Sequence[Result]) -> tuple[Table, ...]:
    """A table of both points by method and axis, and one of all points."""
    rows = tuple(bar.row for bar in _bars(results))
    every = [
        (
            method,
            result.cell.values["axis"],
            p["value"],
            p["good"] / result.answers["n"],
            p["silent"],
            said_text(p["said"]),
        )
        for result in results
        for method, points in result.answers["points"].items()
        for p in points
    ]
    every.sort(key=lambda row: _ORDER.index(row[0]))
    about = (
        f"good: {MIN_SHARE:.0%} of {settings.photos} photographs or {settings.draws} verdicts, {MIN_COVERAGE:.0%} of "
        f"{settings.draws} promises; silent: bad trials that nothing was said about, at the bad points that were tried"
    )
    points = Table("points", "Every point", ("method", "axis", "value", "good", "silent", "said"), tuple(every))
    return Table("breaks", "Where it breaks, and what is said there", BAR_HEAD, rows, about), points


def figures(settings: BreaksSettings, results: Sequence[Result]) -> tuple[Drawing, ...]:
    """The chart: a bar per method and axis."""
    about, bars = tables(settings, results)[0].about, _bars(results)
    return (Drawing("chart", "Where it breaks", partial(draw_bars, bars), (8.3, 0.8 + ROW_IN * len(bars)), about),)


STUDY = Study("breaks", BreaksSettings, cells, run, tables, figures)
