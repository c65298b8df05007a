"""A run's sheets: the design's own page and those of its controls, each with the marker ids that tell it from the
others.

In: finished runs. Out: SHEET.pdf and SHEET.json, or one page with the designs of several and a manifest for each. The
piece is the same on every template that has room for it, but for the ids of its markers. The last page of a template
with `plan_page` says where the piece goes and how to photograph it. Pages that need no run: see `sheets.blank`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from patchproof.optimizer.run import Run
from patchproof.reprints.plan_view import hang
from patchproof.reprints.shot_plan import shot_sections
from patchproof.scene.interface import PieceScene, require_piece
from patchproof.scene.patch_scene import PatchScene, require_patch
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.multi_design import write_several
from patchproof.sheets.piece import control_design, with_ids
from patchproof.sheets.plan_page import PlacementPicture, PlanPage, edge_distances_mm
from patchproof.sheets.rects import size_text
from patchproof.sheets.template import Template, load_template
from patchproof.sheets.write import write_sheet


def sheet(
    run: Run, pdf_path: str | Path, *, template: str | None = None, control: str | None = None, copies: int = 1
) -> Manifest:
    """Write the page of a run's design as a PDF at true size, and its manifest beside it.

    Args:
        run: a run with a printed piece.
        pdf_path: SHEET.pdf; the manifest is SHEET.json.
        template: a template's name or file, in place of the scene's.
        control: print this in place of the design: "mean", "gray", "noise", "shuffled" or "blank".
        copies: pages with the same content, for label rolls.

    Raises:
        Refused: where the piece does not fit the page.
    """
    content, scene = content_of(run, template, control)
    page = load_template(scene.settings.sheet.template)
    plan = plan_of(scene, page, content) if page.plan_page else None
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
    page, made = load_template(name), [content_of(run, name, control) for run in runs]
    plans = [plan_of(scene, page, content) for content, scene in made] if page.plan_page else []
    return write_several(pdf_path, page, [content for content, _ in made], plans)


def content_of(run: Run, template: str | None, control: str | None) -> tuple[SheetContent, PieceScene]:
    """The run's design (or a control) in its piece on that template, with the promise made for that piece."""
    own = require_piece(run.scene)
    scene = own if template is None else own.with_template(template)
    settings = scene.settings.model_dump(mode="json") | {"seed": scene.seed, "printer_model": run.details["printer"]}
    if (imported := run.details.get("imported")) is not None:
        settings["imported"] = {name: imported[name] for name in ("file", "sha256")}
    piece, bent = scene.piece, isinstance(scene, PatchScene) and not scene.placement.is_flat
    if control is not None:
        piece = with_ids(piece, scene.sheet_id, control)
        design = control_design(control, run.design, scene.sheet_id, piece)
        return SheetContent(piece, scene.sheet_id, control, design, settings=settings, bent=bent), scene
    return SheetContent(piece, scene.sheet_id, "design", run.design, run.promise, settings, bent), scene


def plan_of(scene: PieceScene, template: Template, content: SheetContent) -> PlanPage | None:
    """Where the piece goes, whose design it is if not ours and, for a promise, how to photograph it; None where none of
    it can be said.
    """
    hung, sections, imported = None, [], content.settings.get("imported")
    if scene.HAS_OBJECT:
        patch, own = require_patch(scene), scene.settings.patch
        hung = hang(patch, template)
        facing = f"the object's {own.side} side" if own.at_mm is None else "the place where the piece goes"
        placed = [
            f"Seen as you face {facing}. {_edges(hung) if patch.placement.is_flat else _wrapped(patch)}",
            f"The piece is {size_text(scene.piece.size_mm)} mm; {scene.placement_summary()['reason']}.",
        ]
        if template.tiles is not None:
            placed.append(
                "Glue from the top left to the bottom right on a flat table: each tile covers the white flaps of its "
                "neighbors and 1 mm of their picture. Letters name rows, numbers columns."
            )
        sections.append(("Where the piece goes", tuple(placed)))
    if imported is not None and content.kind == "design":
        file = imported["file"] if len(imported["file"]) <= 60 else f"{imported['file'][:57]}..."  # breaks no line
        origin = f"Imported from {file} (SHA-256 {imported['sha256'][:16]}...); it was not optimized here."
        sections.append(("Whose design it is", (origin,)))
    if content.promise is not None:
        sections += shot_sections(content.promise, scene.settings)
    return PlanPage(hung, tuple(sections)) if sections else None


def _edges(hung: PlacementPicture) -> str:
    edges = ", ".join(f"{name} {mm:.0f} mm" for name, mm in edge_distances_mm(hung).items())
    return f"From the piece's cut edge to the outermost edges of that side: {edges}."


def _wrapped(scene: PatchScene) -> str:
    """How bent paper goes on the object, and what a tape measure says beside it."""
    laid_out = scene.tape_measurements()
    text = "Wrap the piece round the object from its middle outwards, its top edge up, without folds or air under it."
    if not laid_out:
        return text
    lengths = ", ".join(f"{tape.edge} {tape.length_mm:.0f} mm {tape.end}" for tape in laid_out)
    return f"{text} Lay a tape on the surface, straight on from the middle of each of the piece's edges: {lengths}."
