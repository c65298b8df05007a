"""A run's sheets: the design's own page and those of its controls, each with the marker ids that tell it from the
others.

In: a finished run. Out: SHEET.pdf and SHEET.json. The promise belongs to the design in the piece it was optimized with:
another template, and with it another frame, would be another promise, which is then made anew. A piece whose blank was
photographed keeps its size on every template, or the template is refused. Before there is a run, `blank_page` writes
the page that such photographs need.
"""

from __future__ import annotations

from pathlib import Path

from patchproof.optimize.problem import set_problem
from patchproof.optimize.promise import PROMISE_VIEWS, promise_from, try_out
from patchproof.optimize.run import Run
from patchproof.scene.scene import build_scene
from patchproof.settings import Refused
from patchproof.sheet.blank import blank_sheet
from patchproof.sheet.board import board_sheet, is_board
from patchproof.sheet.manifest import Manifest
from patchproof.sheet.piece import MODULES, control_design, lay_out_piece
from patchproof.sheet.template import load_template
from patchproof.sheet.write import write_sheet


def sheet_of(run: Run, pdf_path: str | Path, *, template: str | None = None, control: str | None = None) -> Manifest:
    """Write the run's sheet; `control` is mean, grey, noise, shuffled or blank, `template` a name or file in place of
    the scene's.
    """
    scene, promise = run.scene, run.promise
    settings = scene.settings
    if scene.piece is None:
        raise Refused(
            "a run of a patch", "one of the object's own texture", "take object.glb and textures from the run"
        )
    if template is not None and template != settings.sheet.template:
        settings = settings.model_copy(update={"sheet": settings.sheet.model_copy(update={"template": template})})
        scene = build_scene(settings, scene.base, scene.seed)
        if scene.piece.size_mm != run.scene.piece.size_mm and control is None:
            problem = set_problem(scene)
            promise = promise_from(problem, try_out(problem, run.design, scene.draw("promise", PROMISE_VIEWS)))
    kind = control or "design"
    piece = scene.piece
    if control is not None:
        piece = lay_out_piece(piece.design_rect_mm[2:], scene.piece.module_mm * MODULES, scene.sheet_id, kind)
    pixels = run.design if control is None else control_design(kind, run.design, scene.sheet_id)
    return write_sheet(
        pdf_path,
        template=load_template(settings.sheet.template),
        piece=piece,
        sheet_id=scene.sheet_id,
        kind=kind,
        design_srgb8=None if kind == "blank" else pixels,
        promise=promise if control is None else None,
        settings=settings.model_dump(mode="json") | {"seed": scene.seed, "printer_model": run.details["printer"]},
    )


def blank_page(pdf_path: str | Path, *, template: str | None, control: str | None = None) -> Manifest:
    """Write the page of a template with a [blank] or a [board] table, which needs no run; all else does."""
    if control is not None:
        raise Refused(f"the run whose {control} control belongs on the page", "none", "name the run")
    if template is None:
        raise Refused("a run, or the template of a blank page", "neither", "name a run, or --template blank_a4")
    return board_sheet(template, pdf_path) if is_board(template) else blank_sheet(template, pdf_path)
