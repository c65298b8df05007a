"""A printed sheet hung up on its object, to be photographed.

In: a sheet's PDF and the run it was made from, and how it was printed. Out: `MountedSheet`, which takes JPEG photographs
and says where the page lies in them. What hangs there are the pixels that another library reads from the PDF, so that
an error in the page shows here and not at the print shop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.base.color import photo_codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.output import image_bytes
from patchproof.channel.object_box import project_box
from patchproof.channel.printer import Printer, load_printer
from patchproof.evidence.surface import surface_of
from patchproof.optimizer.run import Run
from patchproof.render.photograph import photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.report.coco import PATCH
from patchproof.scene.conditions import Conditions, fields_of
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.scene.patch_scene import PatchScene
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.pdf_raster import attached_manifest, rasterize_piece

# The print is rasterized this much finer than the closest view can see. Rasterizers of pages average code values: fine
# patterns of strong colors came out 2 to 5 % too dark at 1.25, within 1 % at 2.5 and at 5.
OVERSAMPLING = 2.5
DPI_RANGE = (100.0, 400.0)
_SIDE_POINTS = 8
_FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 × 24 mm, to which EXIF's 35 mm focal length refers


@dataclass(frozen=True)
class PhotoTruth:
    """What is known of a simulated photograph.

    Attributes:
        homography_px_from_mm: 3×3 from page millimeters to pixels; None where the piece is bent or absent.
        marker_corners_px: 4×2 pixels (x right, y down) by marker id.
        conditions: drawn values by name, as in `truth.json`; of a scan its `scan_dpi` and `print_scale`.
    """

    homography_px_from_mm: np.ndarray | None
    marker_corners_px: dict[int, np.ndarray]
    conditions: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Return the photograph's entry in `truth.json`."""
        homography = self.homography_px_from_mm
        return {
            "homography_px_from_mm": None if homography is None else homography.tolist(),
            "marker_corners_px": {str(i): corners.tolist() for i, corners in self.marker_corners_px.items()},
            "conditions": self.conditions,
        }


@dataclass(frozen=True)
class ReprintSetup:
    """How a sheet was printed and what hangs there: by another printer than the scene's (a name or a file), larger or
    smaller along x and y, in its place that `control`'s own sheet (mean, gray, noise) or nothing (bare); `path_traced`
    photographs are by a renderer that is not ours (see `path_traced`).
    """

    printer: str | None = None
    print_scale: tuple[float, float] = (1.0, 1.0)
    control: str | None = None
    path_traced: bool = False

    def printer_for(self, scene: Scene) -> Printer:
        """The printer; the scene's own where none is named."""
        if self.printer is None:
            return load_printer(scene.settings.printer.profile, scene.base)
        return load_printer(self.printer)


DEFAULT_SETUP = ReprintSetup()


@dataclass(frozen=True, eq=False)
class MountedSheet:
    """A stage and the sheet that hangs on it: `sent` is its piece as the PDF has it, sRGB 1×3×H×W, for `printer`."""

    stage: Stage
    manifest: Manifest
    sent: Tensor
    printer: Printer
    how: ReprintSetup = DEFAULT_SETUP

    @property
    def scene(self) -> PieceScene:
        """The stage's scene."""
        return require_piece(self.stage.scene)

    @cached_property
    def piece(self) -> PiecePicture | None:
        """What hangs there; None where the object is bare."""
        return None if self.how.control == "bare" else self.printed(self.printer.apply)

    def printed(self, shows: Callable[[Tensor], Tensor]) -> PiecePicture:
        """The piece as a print shows it that makes sRGB as seen of sRGB as sent, 1×3×H×W both."""
        return PiecePicture.of(shows(self.sent)[0].permute(1, 2, 0).contiguous())

    def photograph(self, conditions: Conditions) -> bytes:
        """A JPEG file of one view, of the drawn quality, with the camera's focal length in its EXIF data."""
        if self.how.path_traced:
            from patchproof.reprints.path_traced import photograph_traced  # whose renderer is an extra of its own

            return _stored(photograph_traced(self.stage, self.piece, conditions), self.scene, conditions)
        return take_photo(self.stage, self.piece, conditions)

    def truth(self, conditions: Conditions) -> PhotoTruth:
        """Return where the page's millimeters fall in the photograph of one view, and its conditions."""
        drawn: dict[str, Any] = {name: values[0].tolist() for name, values in fields_of(conditions).items()}
        drawn["print_scale"] = [scale * float(conditions.pose.printed_scale[0]) for scale in self.how.print_scale]
        if self.piece is None:
            return PhotoTruth(None, {}, drawn)
        surface, homography, cut = surface_of(self.manifest), self.px_from_page(conditions), self.manifest.cut_mm[:2]
        corners = {
            i: geometry.apply_homography(homography, page_mm)
            if self.scene.is_flat
            else self.scene.piece_px(conditions, page_mm - cut)
            for i, page_mm in surface.corners_mm.items()
            if i in surface.piece_ids
        }
        return PhotoTruth(geometry.normalize_homography(homography) if self.scene.is_flat else None, corners, drawn)

    def outlines(self, conditions: Conditions) -> dict[str, np.ndarray]:
        """Corners of the object's box, where it has a mesh, and pixels N×2 round the piece, where it faces the camera
        of one view.
        """
        scene, outlines = self.scene, {}
        if isinstance(scene, PatchScene):
            pose, size_px = scene.camera_from_world(conditions)[0], scene.photo_px
            left, top, *end = project_box(scene.outermost_mm, pose, scene.matrix_px(size_px), size_px, scene.camera)
            box = geometry.rect_corners((left, top, end[0] - left, end[1] - top))
            outlines[str(scene.settings.target.label)] = box
        if self.piece is not None and scene.facing(conditions)[0]:
            border = geometry.rect_border((0, 0, *scene.piece.size_mm), _SIDE_POINTS)
            outlines[PATCH] = scene.piece_px(conditions, border)
        return outlines

    def px_from_page(self, conditions: Conditions) -> np.ndarray:
        """3×3 from page millimeters to pixels of one view; of bent paper its tangent plane's, without the lens."""
        x, y, *_ = self.manifest.cut_mm
        piece_from_page = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
        photo_px = self.scene.settings.camera.photo_px
        return self.scene.piece_homographies(conditions, photo_px)[0] @ piece_from_page


def hang(pdf_path: str | Path, run: Run, how: ReprintSetup = DEFAULT_SETUP) -> MountedSheet:
    """The PDF's sheet on the object of its run; refused where it is not of this run."""
    manifest, scene = sheet_scene(pdf_path, run)
    sent, stage = (
        sent_pixels(pdf_path, manifest, scene),
        set_stage(require_piece(scene).with_print_scale(how.print_scale)),
    )
    return MountedSheet(stage, manifest, sent, how.printer_for(scene), how)


def sheet_scene(pdf_path: str | Path, run: Run) -> tuple[Manifest, Scene]:
    """A sheet's manifest and the scene with its template; refused where the sheet is not of this run."""
    manifest = attached_manifest(pdf_path, run.scene.sheet_id)
    own = run.scene.settings.sheet.template
    scene = run.scene.with_template(manifest.settings.get("sheet", {}).get("template", own))
    if manifest.sheet_id != scene.sheet_id:
        expected, do = f"a sheet of this run ({scene.sheet_id})", "name the run that it was made from"
        raise Refused(expected, f"sheet {manifest.sheet_id}", do)
    return manifest, scene


def sent_pixels(pdf_path: str | Path, manifest: Manifest, scene: Scene) -> Tensor:
    """The piece of a PDF as 1×3×H×W sRGB, with more pixels than the closest view can see."""
    finest = scene.closest_px_per_mm(scene.settings.camera.photo_px)
    dpi = float(np.clip(OVERSAMPLING * finest * MM_PER_INCH, *DPI_RANGE))
    return torch.tensor(rasterize_piece(pdf_path, manifest, dpi)).permute(2, 0, 1)[None] / 255


def take_photo(stage: Stage, piece: PiecePicture | None, conditions: Conditions) -> bytes:
    """A JPEG file of one view with the piece, or of the bare object, as `HungSheet.photograph` makes them."""
    with torch.no_grad():
        picture = photograph(stage, piece, conditions, stage.scene.settings.camera.photo_px, jpeg=False)
    return _stored(picture, stage.scene, conditions)


def _stored(picture: Tensor, scene: Scene, conditions: Conditions) -> bytes:
    """A 1×3×H×W sRGB picture as this scene's camera writes it."""
    from PIL import Image

    exif, photo_px = Image.Exif(), scene.settings.camera.photo_px
    if scene.focal_px is not None:
        details = exif.get_ifd(0x8769)
        details[0xA405] = round(scene.focal_px * _FULL_FRAME_DIAGONAL_MM / np.hypot(*photo_px))  # FocalLengthIn35mmFilm
    return jpeg_of(picture, conditions, {"exif": exif})


def jpeg_of(picture: Tensor, conditions: Conditions, options: dict[str, Any] | None = None) -> bytes:
    """A 1×3×H×W sRGB picture as a JPEG file of the view's drawn quality; `options` are Pillow's."""
    codes = photo_codes_from_srgb(picture[0].permute(1, 2, 0).cpu().numpy())
    return image_bytes(codes, "JPEG", {"quality": int(conditions.sensor.jpeg[0])} | (options or {}))
