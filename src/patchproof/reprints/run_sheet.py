"""Write a run's sheets: the design's and those of its controls, each with its own marker ids.

In: finished runs. Out: SHEET.pdf and SHEET.json, or one page with the designs of several runs and a manifest for each.
The piece is the same on every template that has room for it, except for the ids of its markers. The last page of a
template with `plan_page` says where the piece goes, and how many photographs to take, in how many places, from where
and of which controls, so that the answers will not be `cannot_tell`: photographs of one session are alike, and a few in
each of several places prove more than many in one. Pages without a run: see `sheets.blank`.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_border, rect_corners
from patchproof.base.output import check_file
from patchproof.base.sessions import split_evenly
from patchproof.base.settings import NO_PAGE, SceneSettings, background_summary
from patchproof.base.validation import NETWORK_FILE
from patchproof.evidence import verdict
from patchproof.optimizer.promise import PROMISE_VIEWS
from patchproof.optimizer.run import Run
from patchproof.render.photograph import plan_picture
from patchproof.render.stage import set_stage
from patchproof.report.words import promise_summary
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.scene.placement import patch_frame
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest, Promise
from patchproof.sheets.piece import control_design, with_ids
from patchproof.sheets.plan_page import PlacementPicture, PlanPage, edge_distances_mm
from patchproof.sheets.rects import size_text
from patchproof.sheets.template import Template, load_template, page_template
from patchproof.sheets.tiles import plan_tiles
from patchproof.sheets.write import write_several, write_sheet

_PLAN_MARGIN = 1.06  # of the object's extent
SHOT_COUNTS = ((40, 1), (40, 2), (40, 4), (40, 8), (80, 8))  # photographs, sessions


def sheet(
    run: Run,
    pdf_path: str | Path,
    *,
    template: str | None = None,
    control: str | None = None,
    copies: int = 1,
    overwrite: bool = False,
) -> Manifest:
    """Write the page of a run's design as a PDF at true size, and its manifest beside it.

    Args:
        run: a run with a printed piece.
        pdf_path: SHEET.pdf; the manifest is SHEET.json, and all there is of a print without a page.
        template: a template's name or file, in place of the scene's.
        control: print this in place of the design: "mean", "gray", "noise" or "blank".
        copies: pages with the same content, for label rolls.
        overwrite: replace an earlier page and manifest.

    Raises:
        Refused: where the piece does not fit the page.
    """
    for path in (Path(pdf_path), Path(pdf_path).with_suffix(".json")):
        check_file(path, overwrite)
    content, scene = content_of(run, template, control, Path(pdf_path).parent)
    page = page_template(scene.settings.sheet.template)
    plan = plan_of(scene, page, content) if page and page.plan_page else None
    if control == "blank":
        content = replace(content, design_srgb8=None)
    return write_sheet(pdf_path, page, content, plan, copies)


def sheet_of_several(
    runs: Sequence[Run], pdf_path: str | Path, *, template: str | None = None, control: str | None = None
) -> list[Manifest]:
    """Write one page with the designs of several runs, and a manifest for each; on the first run's template unless
    another is named.
    """
    if (name := template or runs[0].scene.settings.sheet.template) == NO_PAGE:
        raise Refused("a page for a sheet together", "prints without one", "write each by itself, or add --template")
    page, contents = load_template(name), [content_of(run, name, control, Path(pdf_path).parent) for run in runs]
    plans = [plan_of(scene, page, content) for content, scene in contents] if page.plan_page else []
    return write_several(pdf_path, page, [content for content, _ in contents], plans)


def content_of(run: Run, template: str | None, control: str | None, folder: Path) -> tuple[SheetContent, PieceScene]:
    """Make the piece's content on that template: the run's design with its promise, or a control; and the scene. The
    sheet, in `folder`, carries a printer that has no name, and says where networks lie from there.
    """
    scene = require_piece(run.scene)
    scene = scene if template is None else scene.with_template(template)
    settings, promise = _portable(scene.settings.model_dump(mode="json"), run.promise, scene, folder)
    settings |= {"seed": scene.seed, "printer_model": run.details["printer"]}
    if (imported := run.details.get("imported")) is not None:
        settings["imported"] = {name: imported[name] for name in ("file", "sha256")}
    piece, bent = scene.piece, isinstance(scene, PatchScene) and not scene.placement.is_flat
    if control is not None:
        piece = with_ids(piece, scene.sheet_id, control)
        design = control_design(control, run.design, scene.sheet_id, piece)
        return SheetContent(piece, scene.sheet_id, control, design, settings=settings, bent=bent), scene
    return SheetContent(piece, scene.sheet_id, "design", run.design, promise, settings, bent), scene


def _portable(settings: dict[str, Any], promise: Promise, scene: Scene, folder: Path) -> tuple[dict[str, Any], Promise]:
    """Return settings and promise without the folders of this machine, for a sheet in `folder`: files by their names,
    networks as seen from there, a printer that has no name by value.
    """

    def from_sheet(name: str) -> str:
        match = NETWORK_FILE.fullmatch(name)
        if match is None or "${" in name or Path(scene.base / match[2]).drive != folder.resolve().drive:
            return name
        return match[1] + Path(os.path.relpath(scene.base / match[2], folder)).as_posix()

    carried = {"sheet": settings["sheet"]}
    if Path(profile := scene.settings.printer.profile).suffix:
        from patchproof.channel.printer import carried_printer

        carried["printer_file"] = carried_printer(scene.base / profile)
    models = tuple(model.changed(name=from_sheet(model.name)) for model in promise.models)
    return without_folders(settings, from_sheet) | carried, promise.changed(models=models)


def without_folders(value: Any, from_sheet: Callable[[str], str]) -> Any:
    """Copy settings, absolute paths as file names, other texts as `from_sheet` has them."""
    if isinstance(value, dict):
        return {key: without_folders(each, from_sheet) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [without_folders(each, from_sheet) for each in value]
    if not isinstance(value, str):
        return value
    return Path(value).name if Path(value).is_absolute() else from_sheet(value)


def plan_of(scene: PieceScene, template: Template, content: SheetContent) -> PlanPage | None:
    """Make the plan page: where the piece goes, the file of an imported design and, with a promise, how to photograph
    it. None if there is nothing to say.
    """
    picture, sections, imported = None, [], content.settings.get("imported")
    if scene.HAS_OBJECT:
        patch, settings = require_patch(scene), scene.settings.patch
        picture = draw_plan_view(patch, template)
        edges = ", ".join(f"{name} {mm:.0f} mm" for name, mm in edge_distances_mm(picture).items())
        facing = f"the object's {settings.side} side" if settings.at_mm is None else "the place where the piece goes"
        lines = [
            f"Seen as you face {facing}. From the piece's cut edge to the outermost edges of that side: {edges}.",
            f"The piece is {size_text(scene.piece.size_mm)} mm; {scene.placement_summary()['reason']}.",
        ]
        if not patch.placement.is_flat:
            lines.append("Wrap it round the object from its middle outwards, without folds or air under it.")
        if template.tiles is not None:
            lines.append(
                "Glue from the top left to the bottom right on a flat table: each tile covers the white flaps of its "
                "neighbors and 1 mm of their picture. Letters name rows, numbers columns."
            )
        sections.append(("Where the piece goes", tuple(lines)))
    if imported is not None and content.kind == "design":
        file = imported["file"] if len(imported["file"]) <= 60 else f"{imported['file'][:57]}..."  # fits on one line
        origin = f"Imported from {file} (SHA-256 {imported['sha256'][:16]}...); it was not optimized here."
        sections.append(("Whose design it is", (origin,)))
    if content.promise is not None:
        sections += shot_sections(content.promise, scene.settings)
    return PlanPage(picture, tuple(sections)) if sections else None


def draw_plan_view(scene: PatchScene, template: Template) -> PlacementPicture:
    """Draw the object as seen from the piece's side, with the piece's outline and, in tiles, its seams."""
    # cameras may count their angles from another side
    scene = replace(scene, frame=patch_frame(scene.mesh, scene.settings.patch))
    frame, placement = scene.frame, scene.placement
    axes = np.stack([frame.right, -frame.up])  # millimeters right and down, from the middle of the object

    def project(points: np.ndarray) -> np.ndarray:  # to the picture's plane
        return np.asarray(points) @ axes.T

    low, high = project(scene.mesh.vertices).min(0), project(scene.mesh.vertices).max(0)
    outline = project(placement.world(rect_border((0, 0, *placement.size_mm), 16)))  # bent paper has bent edges
    half = np.maximum(np.abs([low, high, outline.min(0), outline.max(0)]).max(0) * _PLAN_MARGIN, 1.0)
    seams, names = [], []
    for tile in plan_tiles(template, scene.piece):
        corners = project(placement.world(rect_corners(tile.part_mm)))
        seams += [(tuple(corners[1]), tuple(corners[2])), (tuple(corners[2]), tuple(corners[3]))]
        names.append((tuple(corners.mean(0)), tile.name))
    return PlacementPicture(
        picture=plan_picture(set_stage(scene), scene.frame, half),
        picture_mm=(-half[0], -half[1], 2 * half[0], 2 * half[1]),
        object_mm=(*low, *(high - low)),
        outline_mm=tuple(map(tuple, outline)),
        seams_mm=tuple(seams),
        names_mm=tuple(names),
    )


def shot_sections(promise: Promise, settings: SceneSettings) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Say how many photographs to take, and from where, as (heading, lines)."""
    data = settings.model_dump()
    summary = f"{promise_summary(promise, data)} Promise simulated {background_summary(data)}."
    return (("How many photographs", (summary, *_count_lines(promise))), ("From where", _view_lines(settings)))


def _count_lines(promise: Promise) -> tuple[str, ...]:
    needed = verdict.photos_line(promise, (), promise.best_control)
    promised = (
        f"Promised: {promise.rate:.1%} recognized as {promise.target.label}, of {promise.n} views in "
        f"{promise.sessions} sessions, each with a place, light, camera and print of its own."
    )
    if promise.answer == "does_not_help":
        return promised, needed
    proofs = (
        f"A verdict asks the photographs to prove a rate of {verdict.required_rate(promise):.0%}. What they will show "
        "if the promise holds (the chance that it is enough; the least gain that they show beside as many photographs "
        f"of a control in the same places): {'; '.join(_proof(promise, *counts) for counts in SHOT_COUNTS)}."
        f"{verdict.useless_note(promise)}"
    )
    short = promise.n < PROMISE_VIEWS and not promise.draft
    more = (
        f"A promise of {PROMISE_VIEWS} views (patchproof promise RUN --n {PROMISE_VIEWS}, then this page again) "
        "knows better how much places differ, and often asks for fewer of them."
    )
    pairs = (
        "Take each view twice, with the patch and with the control, under equal file names, each control in a folder "
        "of its own: pairs tell more. A patch helps only if it beats every control that you photograph."
    )
    return promised, proofs, needed, *([more] if short else []), pairs


def _proof(promise: Promise, photos: int, sessions: int) -> str:
    """What so many photographs prove: the counts allowed for, the chance of `kept`, and the least gain they show."""
    split, gain = split_evenly(photos, sessions), verdict.provable_gain(promise, sessions, photos // sessions)
    low, high = promise.posterior.count_interval(split)
    chance, shown = verdict.kept_chance(promise, split), "no gain" if gain is None else f"{gain:.0%}"
    return f"{photos} in {verdict.places_text(sessions)}: {low} to {high} ({chance:.0%}; {shown})"


def _view_lines(settings: SceneSettings) -> tuple[str, ...]:
    if settings.object.mesh is None:
        return ("As the scene's own photographs were taken: the same places, distances and light.",)
    view, patch = settings.view, settings.patch
    target = "object" if view.look_at == "object" else "piece"
    light = "Light as it comes" if settings.light.ambient[0] < 1 else "Bright light"
    front = "the place of the piece" if patch.at_mm is not None else f"the piece's side ({patch.side})"
    if view.front != "patch":
        front = f"the object's {view.front} side"
    return (
        f"Spread over all of these, not the best ones: {_degrees(view.azimuth_deg)} to the left (-) and right (+) of "
        f"facing {front}, {_degrees(view.elevation_deg)} above it, "
        f"{view.distance_mm[0] / 10:.0f} to {view.distance_mm[1] / 10:.0f} cm from the middle of the {target}, the "
        f"camera turned by {_degrees(view.roll_deg)}.",
        f"The {target} belongs in the middle of the picture, the whole piece in view; classifiers see the picture's "
        "centered square.",
        f"{light}, without flash, shine or filters; views outside of these ranges are not counted.",
    )


def _degrees(bounds: tuple[float, float]) -> str:
    return f"{bounds[0]:g}° to {bounds[1]:g}°"
