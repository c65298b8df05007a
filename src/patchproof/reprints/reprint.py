"""Mount a printed sheet on its object in simulation, and photograph it (pages that belong to no run: `page_photos`).

In: a sheet's PDF, the run it was made from, and how it was printed. Out: `MountedSheet`, which takes JPEG photographs
and computes where the page lies in them; by `reprint` a folder of them, `truth.json` with each one's homography and
conditions, `coco.json` with boxes of object and piece, and for a print without markers `corners.csv`, which `verify
--corners` takes. The piece's pixels are read from the PDF by another library, so that an error in the page shows here
and not at the print shop. Conditions come from the reprint stream, which nothing else uses: one print, photographed in
one or several sessions, each with its own place, light, camera and folder.
"""

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.base.color import photo_codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.output import image_bytes, make_folder, new_folder
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.base.settings import NO_PAGE
from patchproof.base.text import short_repr
from patchproof.base.workers import fork_workers, result_of
from patchproof.channel.object_box import project_box
from patchproof.channel.printer import Printer, load_printer
from patchproof.optimizer.run import Run
from patchproof.render.photograph import photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.report.coco import PATCH, LabeledPhoto, coco_json
from patchproof.reprints.run_sheet import sheet as sheet_of
from patchproof.scene.conditions import Conditions, fields_of
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.scene.patch_scene import PatchScene
from patchproof.sheets.manifest import Manifest, load_manifest
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_piece

# The print is rasterized this much finer than the closest view resolves. Rasterizers of pages average code values: fine
# patterns of strong colors became 2 to 5 % too dark at 1.25, within 1 % at 2.5 and at 5.
OVERSAMPLING = 2.5
DPI_RANGE = (100.0, 400.0)
SIDE_POINTS = 8
_FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 × 24 mm, to which EXIF's 35 mm focal length refers


@dataclass(frozen=True)
class PhotoTruth:
    """Ground truth of a simulated photograph: 3×3 from page millimeters to pixels (x right, y down), None where the
    piece is bent or absent, and drawn values by name.
    """

    homography_px_from_mm: np.ndarray | None
    conditions: dict[str, Any]


def render_photo(stage: Stage, piece: PiecePicture | None, conditions: Conditions) -> Tensor:
    """Render one view with the piece (None: of the bare object) at the camera's size: 1×3×H×W sRGB, without JPEG."""
    with torch.no_grad():
        return photograph(stage, piece, conditions, stage.scene.photo_px, jpeg=False)


@dataclass(frozen=True)
class ReprintSetup:
    """Options of printing and mounting a sheet: `printer` (a name or a file; None: the scene's), the `print_scale` of
    its sides, `control` in place of the design (mean, gray or noise on its own sheet, or bare: nothing), `render` for
    another renderer than ours (a stage, the piece or None, and one view to 1×3×H×W sRGB).
    """

    printer: str | None = None
    print_scale: float = 1.0
    control: str | None = None
    render: Callable[[Stage, PiecePicture | None, Conditions], Tensor] = render_photo


DEFAULT_SETUP = ReprintSetup()


@dataclass(frozen=True, eq=False)
class MountedSheet:
    """A stage and the sheet mounted on it; `sent_srgb` is its piece as sent to `printer`, 1×3×H×W."""

    stage: Stage
    manifest: Manifest
    sent_srgb: Tensor
    printer: Printer
    how: ReprintSetup = DEFAULT_SETUP

    @property
    def scene(self) -> PieceScene:
        """The stage's scene."""
        return require_piece(self.stage.scene)

    @cached_property
    def piece(self) -> PiecePicture | None:
        """The printed piece; None on a bare object."""
        return None if self.how.control == "bare" else self.printed(self.printer.apply)

    def printed(self, apply_print: Callable[[Tensor], Tensor]) -> PiecePicture:
        """Print the piece: `apply_print` maps sRGB as sent to sRGB as seen, 1×3×H×W both."""
        return PiecePicture.of(apply_print(self.sent_srgb)[0].permute(1, 2, 0).contiguous())

    def photograph(self, conditions: Conditions) -> bytes:
        """Take a JPEG photograph of one view, of the drawn quality, with the camera's focal length in its EXIF data."""
        from PIL import Image

        exif, focal_px = Image.Exif(), self.scene.focal_px
        if focal_px is not None:
            full_frame_mm = focal_px * _FULL_FRAME_DIAGONAL_MM / np.hypot(*self.scene.photo_px)
            exif.get_ifd(0x8769)[0xA405] = round(full_frame_mm)  # FocalLengthIn35mmFilm
        return jpeg_of(self.how.render(self.stage, self.piece, conditions), conditions, {"exif": exif})

    def truth(self, conditions: Conditions) -> PhotoTruth:
        """Compute the homography from page millimeters to one view's photograph, and its conditions."""
        values: dict[str, Any] = {name: values[0].tolist() for name, values in fields_of(conditions).items()}
        if self.piece is None or not self.scene.is_flat:
            return PhotoTruth(None, values)
        x, y, *_ = self.manifest.cut_mm
        px_from_piece = self.scene.piece_homographies(conditions, self.scene.photo_px)[0]
        px_from_page = px_from_piece @ np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
        return PhotoTruth(geometry.normalize_homography(px_from_page), values)

    def outlines(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Outlines N×2 in pixels of one view: corners of the object's box, if it has a mesh, and the piece's border, if
        it faces the camera.
        """
        scene, outlines = self.scene, {}
        if isinstance(scene, PatchScene):
            pose, size_px = scene.camera_from_world(conditions)[0], scene.photo_px
            left, top, *end = project_box(scene.outermost_mm, pose, scene.matrix_px(size_px), size_px, scene.camera)
            outlines[str(scene.settings.target.label)] = geometry.rect_corners((left, top, end[0] - left, end[1] - top))
        if self.piece is not None and scene.facing(conditions)[0]:
            border = geometry.rect_border((0, 0, *scene.piece.size_mm), SIDE_POINTS)
            outlines[PATCH] = scene.piece_px(conditions, border)
        return outlines


def mount_sheet(pdf_path: str | Path, run: Run, how: ReprintSetup = DEFAULT_SETUP) -> MountedSheet:
    """Mount the PDF's sheet on the object of its run; refused if the sheet is not of this run."""
    manifest, scene = sheet_scene(pdf_path, run)
    sent_srgb = sent_pixels(pdf_path, manifest, scene)
    profile = scene.settings.printer.profile
    printer = load_printer(profile, scene.base) if how.printer is None else load_printer(how.printer)
    return MountedSheet(set_stage(require_piece(scene)), manifest, sent_srgb, printer, how)


def sheet_scene(pdf_path: str | Path, run: Run) -> tuple[Manifest, Scene]:
    """Read a sheet's manifest, and set its run's scene to the sheet's template; refused if it is not of this run."""
    is_manifest = Path(pdf_path).suffix == ".json"  # of a print without a page
    manifests = [load_manifest(pdf_path)] if is_manifest else attached_manifests(pdf_path)
    default = run.scene.settings.sheet.template
    scene = run.scene.with_template(manifests[0].settings.get("sheet", {}).get("template", default))
    manifest = next((each for each in manifests if each.sheet_id == scene.sheet_id), manifests[0])
    if is_manifest and (manifest.design is None or manifest.settings.get("sheet", {}).get("template") != NO_PAGE):
        expected = "a PDF of a sheet, or the manifest of a print without a page"
        raise Refused(expected, str(pdf_path), "name the PDF beside it")
    if manifest.sheet_id != scene.sheet_id:
        expected, do = f"a sheet of this run ({scene.sheet_id})", "name the run that it was made from"
        raise Refused(expected, f"sheet {manifest.sheet_id}", do)
    return manifest, scene


def sent_pixels(pdf_path: str | Path, manifest: Manifest, scene: Scene) -> Tensor:
    """Rasterize the piece of a PDF to 1×3×H×W sRGB, finer than the closest view resolves; a print without a page has
    the design's own pixels.
    """
    if Path(pdf_path).suffix == ".json" and manifest.design is not None:
        return torch.tensor(manifest.design.pixels()).permute(2, 0, 1)[None] / 255
    dpi = float(np.clip(OVERSAMPLING * scene.closest_px_per_mm(scene.photo_px) * MM_PER_INCH, *DPI_RANGE))
    return torch.tensor(rasterize_piece(pdf_path, manifest, dpi)).permute(2, 0, 1)[None] / 255


def jpeg_of(picture: Tensor, conditions: Conditions, options: dict[str, Any] | None = None) -> bytes:
    """Encode a 1×3×H×W sRGB picture as JPEG of the view's drawn quality; `options` are Pillow's."""
    codes = photo_codes_from_srgb(picture[0].permute(1, 2, 0).cpu().numpy())
    return image_bytes(codes, "JPEG", {"quality": int(conditions.sensor.jpeg[0])} | (options or {}))


REPRINT_FILES = ("photo_*.jpg", "session_*", "truth.json", "coco.json", "corners.csv")


@dataclass(frozen=True)
class Reprint:
    """Simulated photographs in a folder, with the truth about each by file name."""

    folder: Path
    photos: dict[str, PhotoTruth]
    __repr__ = short_repr


def reprint(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    how: ReprintSetup = DEFAULT_SETUP,
    *,
    sessions: int = 1,
    seed: int | None = None,
    compute: Compute = Compute(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Reprint:
    """Print a sheet in simulation, mount the piece on its object, and photograph it.

    Args:
        pdf_path: the sheet's PDF with its manifest beside it, or NAME.json of a print without a page.
        run: the run that the sheet was made from.
        n: photographs in all, 1 or more.
        out: folder for the JPEG files, `truth.json` and `coco.json`; one folder a session inside, if there are several.
        how: printer, print scale, a control in place of the design, and the renderer.
        sessions: places to photograph in, 1 to n, each with a light and camera of its own.
        seed: of the conditions, in place of the scene's.
        compute: processes; the renderer runs on the CPU: another device is refused, and so is a cluster.
        overwrite: delete earlier photographs in `out` first.
        progress: called with the stage "photograph".

    Raises:
        Refused: where the PDF is not of this run.
    """
    compute = compute.without("reprint", device=True, cluster=True)
    if not 1 <= sessions <= n:
        raise Refused(f"1 to {n} sessions of {n} photographs", f"{sessions}", "ask for fewer")
    with TemporaryDirectory() as temporary:
        pdf = Path(pdf_path)
        if how.control not in (None, "bare"):
            template, pdf = sheet_scene(pdf, run)[1].settings.sheet.template, Path(temporary) / f"control{pdf.suffix}"
            sheet_of(run, pdf, template=template, control=how.control)
        sheet = mount_sheet(pdf, run, how)
        each, done = -(-n // sessions), 0
        conditions = sheet.scene.draw("reprint", n, seed, per_session=each)
        scale = how.print_scale * conditions.pose.printed_scale[[0] * n]  # one print, wherever it is photographed
        pose = replace(conditions.pose, printed_scale=scale)
        conditions = replace(conditions, print=conditions.print[[0] * n], pose=pose)
        views = [conditions[i : i + 1] for i in range(n)]
        names = [f"photo_{i + 1:04d}.jpg" for i in range(n)]
        if sessions > 1:
            names = [f"session_{i // each + 1:02d}/{name}" for i, name in enumerate(names)]
        opening = fork_workers(sheet.photograph, compute.jobs)
        with new_folder(out, REPRINT_FILES, overwrite, (pdf_path, run.folder)) as folder, opening as (workers, take):
            for i, photo in workers.completed(take, views):
                make_folder((folder / names[i]).parent)
                (folder / names[i]).write_bytes(result_of(photo))
                done += 1
                progress("photograph", done, n)
            label, size_px = str(sheet.scene.settings.target.label), sheet.scene.photo_px
            photos = [LabeledPhoto(name, size_px, sheet.outlines(v)) for name, v in zip(names, views, strict=True)]
            text = coco_json(photos, label, f"simulated photographs of sheet {sheet.manifest.sheet_id}")
            (folder / "coco.json").write_text(text, encoding="utf-8")
            truth = dict(zip(names, map(sheet.truth, views), strict=True))
            text = json.dumps({name: vars(each) for name, each in truth.items()}, indent=1, default=np.ndarray.tolist)
            (folder / "truth.json").write_text(text + "\n", encoding="utf-8")
            if not sheet.manifest.markers:
                from patchproof.evidence.annotations import CORNERS_FILE, corners_csv

                shown = {photo.file: photo.outlines[PATCH] for photo in photos if PATCH in photo.outlines}
                text = corners_csv({name: outline[::SIDE_POINTS] for name, outline in shown.items()})
                (folder / CORNERS_FILE).write_text(text, encoding="utf-8")
    return Reprint(Path(out), truth)
