"""Compare layouts of a piece: their cost in recognition, their benefit in finding and measuring the sheet.

In: scene files, networks, seeds and layouts: number and size of markers, white around them, a design all over the
piece or in a frame of markers, and other changes of the scene file: the piece's size or place, its training. Out: per
cell a design is trained in that layout and shown, beside the controls, under unseen conditions; then its sheet is
printed, mounted, photographed, found and measured against the renderer's truth. All layouts of a scene, network and
seed share their draws; intervals are over such groups, since designs differ by chance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import Field

from patchlab.study import grid
from patchlab.study.estimates import clustered_median, mean
from patchlab.study.record import Record, corner_error_mm, gain_of, hardest_control, to_record
from patchlab.study.study import Cell, Result, Study
from patchlab.validation.mounted_sheets import mount_content
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.intervals import Estimate, rate
from patchproof.base.output import image_pixels
from patchproof.base.validation import Positive, StrictModel
from patchproof.evidence.camera import pinhole_photo
from patchproof.evidence.measure import measure
from patchproof.evidence.ranges import promised_ranges
from patchproof.evidence.surface import promised_of, surface_of
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.place_search import choose_place
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import CONTROLS, pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.photo.read import Photo
from patchproof.report.tables import Drawing, Table, Value
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.scene.unplaced_scene import UnplacedScene
from patchproof.sheets.content import SheetContent
from patchproof.sheets.piece import SCISSORS_MM, Piece, lay_out_piece
from patchproof.sheets.rects import RectMm, grow_rect

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Layout(StrictModel):
    """One way to lay out a piece."""

    markers: Literal[4, 8] = 4  # in the corners; 8: also in the middle of each side
    size: Positive = 1.0  # factor of the marker size that the scene's views need
    quiet: Positive = 1.0  # modules of white between a marker and the design
    framed: bool = False  # put the design inside a white frame with the markers
    scene: dict[str, dict[str, Any]] = Field(default_factory=dict)  # changes of the scene file, by table and key


_LAYOUTS = {
    "whole": Layout(),
    "eight markers": Layout(markers=8),
    "markers × 0.7": Layout(size=0.7),
    "half the white": Layout(quiet=0.5),
    "twice the white": Layout(quiet=2.0),
    "framed": Layout(markers=8, framed=True),
}


class LayoutsSettings(grid.GridSettings):
    """Settings: a design for each scene, network, seed and layout."""

    layouts: dict[str, Layout] = Field(_LAYOUTS, min_length=1)  # by name; the others are compared with the first
    n: grid.PositiveInt = 400  # unseen conditions that measure
    photos: Annotated[int, Field(ge=0)] = 40  # photographs of each design's sheet


@dataclass(frozen=True)
class PieceVariant(Piece):
    """A piece with other pixels reserved for its markers."""

    quiet: float = 1.0
    framed: bool = False

    @property
    def reserved_mm(self) -> tuple[RectMm, ...]:
        """The white around each marker, or the four sides of a frame."""
        if not self.framed:
            wider = (self.quiet - 1) * self.module_mm
            rects = (grow_rect(rect, wider) for rect in super().reserved_mm)
            return tuple(_clip_rect(rect, self.size_mm) for rect in rects)
        (width, height), frame = self.size_mm, self.marker_mm + 2 * self.module_mm + SCISSORS_MM
        sides = ((0.0, 0.0, width, frame), (0.0, height - frame, width, frame))
        return (*sides, (0.0, 0.0, frame, height), (width - frame, 0.0, frame, height))


def _clip_rect(rect: RectMm, size_mm: tuple[float, float]) -> RectMm:
    low = [max(v, 0.0) for v in rect[:2]]
    high = [min(v + side, whole) for v, side, whole in zip(rect[:2], rect[2:], size_mm, strict=True)]
    return low[0], low[1], high[0] - low[0], high[1] - low[1]


def with_layout(scene: PatchScene, layout: Layout) -> PatchScene:
    """The scene with its piece in another layout."""
    piece = scene.piece
    other = lay_out_piece(piece.size_mm, layout.size * piece.marker_mm, scene.sheet_id, "design", layout.markers == 8)
    plain = {field.name: getattr(other, field.name) for field in fields(other)}
    return replace(scene, piece=PieceVariant(**plain, quiet=layout.quiet, framed=layout.framed))


def cells(settings: LayoutsSettings, base: Path) -> list[Cell]:
    """A cell per scene, network, seed and layout."""
    ways = [(name, layout.scene, layout.model_dump()) for name, layout in settings.layouts.items()]
    return grid.grid_cells(
        settings,
        base,
        lambda values: ((grid.with_changes(values, scene) | {"layout": a, "how": how}, (a,)) for a, scene, how in ways),
    )


def run(settings: LayoutsSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Train (after a place search if the scene asks for one), show under unseen conditions, and photograph."""
    problem = _build_cell_problem(base, cell)
    scene = with_layout(require_patch(problem.scene), Layout(**cell.values["how"]))
    patch = replace(problem.patch, scene=scene)
    problem = replace(problem, scene=scene, stage=replace(problem.stage, scene=scene), subject=patch)
    design = best_design(problem)
    shown = pictures_with_controls(problem, design, CONTROLS)
    answers = responses(problem, shown, scene.draw("evaluate", settings.n))
    measured = _photograph_and_measure(problem, scene, design, settings.photos)
    return to_record(answers) | {"free": _free_share(scene.piece)} | measured


def _build_cell_problem(base: Path, cell: Cell) -> Problem:
    scene, networks = grid.scene_of(base, cell.values), grid.network_names(base, cell.values)
    if isinstance(scene, UnplacedScene):
        place = choose_place(scene, models=networks)
        scene = scene.with_piece_at(place.at, place.spin_deg)
    return set_problem(scene, models=networks)


def _free_share(piece: Piece) -> float:
    scale = 4  # samples per millimeter
    mask = np.ones([int(side * scale) for side in piece.size_mm], bool)
    for x, y, w, h in piece.reserved_mm:
        mask[int(x * scale) : int((x + w) * scale), int(y * scale) : int((y + h) * scale)] = False
    return float(mask.mean())


def _photograph_and_measure(problem: Problem, scene: PatchScene, design: np.ndarray, count: int) -> dict[str, Any]:
    """Measure photographs of the design's sheet as `verify` does, with errors against the truth, by photograph."""
    sheet = mount_content(problem.stage, SheetContent(scene.piece, scene.sheet_id, "design", design))
    manifest = sheet.manifest
    surface = surface_of(manifest)
    promised, drawn = promised_of(manifest, surface, sheet.printer), scene.draw("reprint", count)
    out: dict[str, list] = {"status": [], "error_mm": [], "uncertainty_mm": [], "delta_e00": []}
    for i in range(count):
        conditions = drawn[i : i + 1]
        photo = Photo(image_pixels(sheet.photograph(conditions)), float(scene.matrix_px(scene.photo_px)[0, 0]))
        entry = measure(pinhole_photo(photo, None), "photo.jpg", surface, promised, promised_ranges(())).entry
        geometry, error = entry.geometry, None
        if geometry is not None and scene.is_flat:
            corners = rect_corners(manifest.cut_mm)
            error = corner_error_mm(geometry, corners, apply_homography(sheet.px_from_page(conditions), corners))
        out["status"].append(entry.status)
        out["error_mm"].append(error)
        out["uncertainty_mm"].append(geometry and geometry.corner_uncertainty_mm)
        out["delta_e00"].append(entry.color and entry.color.delta_e00_mean)
    return out


def _gain_over_controls(result: Result) -> float:
    return gain_of(result, "design", hardest_control(result, CONTROLS))


def tables(settings: LayoutsSettings, results: Sequence[Result]) -> Sequence[Table]:
    """Tables of costs and gains by layout, and of every cell."""
    by_layout = grid.group_by(results, lambda result: result.cell.values["layout"])
    first = {grid.cell_key(result): _gain_over_controls(result) for result in next(iter(by_layout.values()))}
    rows = [(name, *_layout_figures(group, first)) for name, group in by_layout.items()]
    head = ("layout", "share for the design", "gain over the best control", "beside the first layout")
    head = (*head, "identified", "measured", "corner error, mm", "uncertainty holds", "ΔE00")
    about = f"{settings.n} unseen conditions and {settings.photos} photographs of each design; corner errors are "
    about += "medians of the worst of the piece's four; gains are over scenes, networks and seeds"
    things = ("design", *CONTROLS)
    every = [
        (
            *grid.cell_key(r),
            r.cell.values["layout"],
            _gain_over_controls(r),
            *(Record([r], thing).level()[0] for thing in things),
        )
        for r in results
    ]
    return (
        Table("layouts", "What layouts cost and buy", head, tuple(rows), about),
        Table("cells", "Every design", ("scene", "network", "seed", "layout", "gain", *things), tuple(every)),
    )


def _layout_figures(group: Sequence[Result], first: dict) -> tuple:
    status = [word for result in group for word in result.answers["status"]]
    measured = [
        {key: result.answers[key][i] for key in ("error_mm", "uncertainty_mm", "delta_e00")}
        for result in group
        for i, word in enumerate(result.answers["status"])
        if word == "measured"
    ]
    errors = [(m["error_mm"], m["uncertainty_mm"]) for m in measured if m["error_mm"] is not None]
    beside = [
        _gain_over_controls(result) - first[grid.cell_key(result)] for result in group if grid.cell_key(result) in first
    ]
    return (
        float(np.mean([result.answers["free"] for result in group])),
        _mean_or_single([_gain_over_controls(result) for result in group]),
        _mean_or_single(beside),
        rate([word != "rejected" for word in status]),
        rate([word == "measured" for word in status]),
        clustered_median(np.array([[error] for error, _ in errors])) if errors else None,
        rate([error <= stated for error, stated in errors]),
        mean([m["delta_e00"] for m in measured if m["delta_e00"] is not None]),
    )


def _mean_or_single(values: Sequence[float]) -> Estimate | float | None:
    return values[0] if len(values) == 1 else mean(values)


def figures(settings: LayoutsSettings, results: Sequence[Result]) -> Sequence[Drawing]:
    """A plot of gain against the share of measured photographs, if there are photographs."""
    table = tables(settings, results)[0]
    if not settings.photos:
        return []

    def draw(figure: "Figure") -> None:
        axes = figure.subplots()
        for name, _, gain, _, _, measured, *_ in table.rows:
            (x, x_span), (y, y_span) = _value_and_reach(measured), _value_and_reach(gain)
            axes.errorbar([x], [y], y_span, x_span, "o", label=name)
        axes.set_xlabel("photographs measured")
        axes.set_ylabel("gain over the best control")
        axes.legend(fontsize=8)

    return (Drawing("layouts", "What layouts cost and buy", draw, (7.0, 4.5), table.about),)


def _value_and_reach(value: Value) -> tuple[float, list[list[float]] | None]:
    if isinstance(value, Estimate):
        return value.value, [[value.value - value.low], [value.high - value.value]]
    return float(value or 0), None


STUDY = Study("layouts", LayoutsSettings, cells, run, tables, figures)
