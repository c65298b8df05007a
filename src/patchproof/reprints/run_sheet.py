"""Write a run's sheets: the design's and those of its controls, each with its own marker ids.

In: finished runs. Out: SHEET.pdf and SHEET.json, or one page with the designs of several runs and a manifest for each.
The piece is the same on every template that has room for it, except for the ids of its markers. The last page of a
template with `plan_page` says where the piece goes and how to photograph it. Pages without a run: see `sheets.blank`.
"""

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from patchproof.base.output import check_file
from patchproof.base.validation import NETWORK_FILE
from patchproof.optimizer.run import Run
from patchproof.reprints.plan_view import draw_plan_view
from patchproof.reprints.shot_plan import shot_sections
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest, Promise
from patchproof.sheets.piece import control_design, with_ids
from patchproof.sheets.plan_page import PlacementPicture, PlanPage, edge_distances_mm
from patchproof.sheets.rects import size_text
from patchproof.sheets.template import Template, load_template, page_template
from patchproof.sheets.write import write_several, write_sheet


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
    name = template or runs[0].scene.settings.sheet.template
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
        facing = f"the object's {settings.side} side" if settings.at_mm is None else "the place where the piece goes"
        lines = [
            f"Seen as you face {facing}. {_edge_distances(picture)}",
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


def _edge_distances(picture: PlacementPicture) -> str:
    edges = ", ".join(f"{name} {mm:.0f} mm" for name, mm in edge_distances_mm(picture).items())
    return f"From the piece's cut edge to the outermost edges of that side: {edges}."
