"""Simulated reprints: the PDF itself, printed by a printer model, put back on the object and photographed.

In: a sheet's PDF and the run it belongs to. Out: a folder of JPEG photographs at the scene's `photo_px`, as a phone
would write them (EXIF focal length), and `truth.json` with each one's homography, marker corners and conditions. What
is photographed are the pixels that another library reads from the PDF, so that an error in the page shows here and not
at the print shop. With `scan_dpi` the uncut page is scanned flat instead. Conditions come from the reprint stream,
which nothing else has seen.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

from patchproof import geometry
from patchproof.channel import lens
from patchproof.channel.printer import Printer, load_printer
from patchproof.evidence.surface import surface_of
from patchproof.optimizer.run import Run, load_run
from patchproof.output import make_folder, new_folder
from patchproof.printing.sheet import sheet_of
from patchproof.render.photograph import photograph
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.reprints.path_traced import photograph_traced
from patchproof.scene.conditions import Conditions, fields_of
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.scene import Scene, build_scene
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.raster import attached_manifest, page_pixels, piece_pixels
from patchproof.strict import Refused
from patchproof.workers import open_workers, result_of

# The print is rasterized this much finer than the closest view can see. Rasterizers of pages average code values: fine
# patterns of strong colors came out 2 to 5 % too dark at 1.25, within 1 % at 2.5 and at 5.
OVERSAMPLING = 2.5
DPI_RANGE = (100.0, 400.0)
_FULL_FRAME_DIAGONAL_MM = 43.2666  # of 36 × 24 mm, to which EXIF's 35 mm focal length refers
SCAN_QUALITY, SCAN_BLUR_PX = 95, 0.8  # a flatbed's JPEG and its softness, in pixels of twice the scan's resolution
OWN = ("photo_*.jpg", "scan_*.jpg", "truth.json")


def reprint(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    *,
    seed: int | None = None,
    printer: str | None = None,
    print_scale: tuple[float, float] = (1.0, 1.0),
    control: str | None = None,
    path_traced: bool = False,
    overwrite: bool = False,
    jobs: int = 1,
    cluster: str | None = None,
    on_photo: Callable[[int, int], None] = lambda done, total: None,
) -> dict:
    """Write n photographs and truth.json into the folder `out`; returns the truth.

    `control` hangs up that control's own sheet (mean, grey, noise) in place of the PDF's, or nothing (bare).
    `path_traced` takes them with a renderer that is not ours (see `path_traced`).
    """
    if control not in (None, "bare"):
        # beside the photographs, where other machines may look, too
        make_folder(Path(out).resolve().parent)
        with TemporaryDirectory(dir=Path(out).resolve().parent, prefix=".control.") as folder:
            control_pdf = Path(folder) / "control.pdf"
            template = sheet_scene(pdf_path, run)[1].settings.sheet.template
            sheet_of(run, control_pdf, template=template, control=control)
            return reprint(
                control_pdf,
                run,
                n,
                out,
                seed=seed,
                printer=printer,
                print_scale=print_scale,
                path_traced=path_traced,
                overwrite=overwrite,
                jobs=jobs,
                cluster=cluster,
                on_photo=on_photo,
            )
    bare = control == "bare"
    manifest, scene = sheet_scene(pdf_path, run)
    scene = scaled_print(scene, print_scale)
    conditions, truth = scene.draw("reprint", n, seed), {}
    if jobs == 1 and cluster is None:
        piece = None if bare else printed_piece(pdf_path, manifest, scene, printer_of(run, printer))
        take = partial(_take, set_stage(scene), piece, path_traced)
    else:
        hung = _Hung(Path(pdf_path).resolve(), run.folder.resolve(), printer, print_scale, bare)
        take = partial(_take_there, hung, path_traced)
    with new_folder(out, OWN, overwrite) as folder, open_workers(jobs, cluster) as workers:
        each = [conditions[i : i + 1] for i in range(n)]
        done = 0
        for i, photo in workers.completed(take, each):
            (folder / _photo_name(i)).write_bytes(result_of(photo))
            done += 1
            on_photo(done, n)
        for i, one in enumerate(each):
            truth[_photo_name(i)] = _truth(scene, None if bare else manifest, one, print_scale)
        write_json(folder / "truth.json", truth)
    return truth


@dataclass(frozen=True)
class _Hung:
    """All that another process needs to set the stage for itself."""

    pdf: Path
    run_folder: Path
    printer: str | None
    print_scale: tuple[float, float]
    bare: bool


@lru_cache(maxsize=1)
def _hung_up(hung: _Hung) -> tuple[Stage, PiecePicture | None]:
    run = load_run(hung.run_folder)
    manifest, scene = sheet_scene(hung.pdf, run)
    scene = scaled_print(scene, hung.print_scale)
    piece = None if hung.bare else printed_piece(hung.pdf, manifest, scene, printer_of(run, hung.printer))
    return set_stage(scene), piece


def _take_there(hung: _Hung, path_traced: bool, conditions: Conditions) -> bytes:
    return _take(*_hung_up(hung), path_traced, conditions)


def _take(stage: Stage, piece: PiecePicture | None, path_traced: bool, conditions: Conditions) -> bytes:
    buffer = BytesIO()
    if path_traced:
        picture = photograph_traced(stage, piece, conditions)[0].permute(1, 2, 0)
        save_photo(picture, stage.scene, int(conditions.sensor.jpeg[0]), buffer)
    else:
        take_photo(stage, piece, conditions, buffer)
    return buffer.getvalue()


def _photo_name(i: int) -> str:
    return f"photo_{i + 1:04d}.jpg"


def scan(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    dpi: float,
    *,
    printer: str | None = None,
    print_scale: tuple[float, float] = (1.0, 1.0),
    overwrite: bool = False,
) -> dict:
    """Write n flat scans of each uncut page with markers, printed at `print_scale` and scanned at `dpi`."""
    manifest, _ = sheet_scene(pdf_path, run)
    shown, truth = printer_of(run, printer), {}
    px_from_mm = np.diag([dpi / 25.4 * print_scale[0], dpi / 25.4 * print_scale[1], 1.0])
    with new_folder(out, OWN, overwrite) as folder:
        for page in sorted({marker.page for marker in manifest.markers}):
            picture = _scanned(page_pixels(pdf_path, page, 2 * dpi), manifest.page_mm, dpi, shown, print_scale)
            corners = {
                str(m.id): geometry.apply_homography(px_from_mm, m.corners_mm).tolist()
                for m in manifest.markers
                if m.page == page
            }
            for _ in range(n):
                name = f"scan_{len(truth) + 1:04d}.jpg"
                Image.fromarray(_bytes(picture)).save(folder / name, "JPEG", quality=SCAN_QUALITY)
                truth[name] = {
                    "homography_px_from_mm": (px_from_mm @ _page_from_design(manifest, page)).tolist(),
                    "marker_corners_px": corners,
                    "conditions": {"scan_dpi": dpi, "print_scale": list(print_scale)},
                }
        write_json(folder / "truth.json", truth)
    return truth


def _scanned(page: np.ndarray, page_mm, dpi: float, printer: Printer, print_scale: tuple[float, float]) -> np.ndarray:
    """A page's pixels, twice as fine as the scan, as the scanner shows their print: H×W×3 in [0, 1]."""
    import cv2

    with torch.no_grad():
        seen = printer.apply(torch.tensor(page).permute(2, 0, 1)[None] / 255)[0].permute(1, 2, 0).numpy()
    # a pixel (x + ½) of the page falls on scale / 2 · (x + ½) of the scan
    matrix = np.array(
        [[scale / 2 if i == j else 0 for j in (0, 1)] + [scale / 4 - 0.5] for i, scale in enumerate(print_scale)]
    )
    size_px = tuple(round(side * dpi / 25.4) for side in page_mm)
    return cv2.warpAffine(cv2.GaussianBlur(seen, (0, 0), SCAN_BLUR_PX), matrix, size_px, borderValue=(1.0, 1.0, 1.0))


def _page_from_design(manifest: Manifest, page: int) -> np.ndarray:
    """3×3 from the millimetres of the design's page to a tile's; pages without a tile keep their own."""
    square = {t.page: np.vstack([np.array(t.page_from_design_mm), [0, 0, 1]]) for t in manifest.tiles}
    if page not in square:
        return np.eye(3)
    own = square[manifest.design.page if manifest.design else manifest.tiles[0].page]
    return square[page] @ np.linalg.inv(own)


def sheet_scene(pdf_path: str | Path, run: Run) -> tuple[Manifest, Scene]:
    """A sheet's manifest and the scene with its template's frame; refused where the sheet is not of this run."""
    manifest = attached_manifest(pdf_path, run.scene.sheet_id)
    settings, scene = run.scene.settings, run.scene
    template = manifest.settings.get("sheet", {}).get("template", settings.sheet.template)
    if template != settings.sheet.template:
        settings = settings.model_copy(update={"sheet": settings.sheet.model_copy(update={"template": template})})
        scene = build_scene(settings, scene.base, scene.seed)
    if manifest.sheet_id != scene.sheet_id:
        raise Refused(
            f"a sheet of this run ({scene.sheet_id})",
            f"sheet {manifest.sheet_id}",
            "name the run that it was made from",
        )
    return manifest, scene


def printed_piece(pdf_path: str | Path, manifest: Manifest, scene: Scene, printer: Printer) -> PiecePicture:
    """The piece of a PDF as this printer shows it, with more pixels than the closest view can see."""
    finest = scene.closest_px_per_mm(scene.settings.camera.photo_px)
    dpi = float(np.clip(OVERSAMPLING * finest * 25.4, *DPI_RANGE))
    pixels = torch.tensor(piece_pixels(pdf_path, manifest, dpi)).permute(2, 0, 1)[None] / 255
    printed = printer.apply(pixels)[0].permute(1, 2, 0)
    whole = (0, 0, printed.shape[1], printed.shape[0])
    return PiecePicture(printed, whole, whole)


def scaled_print(scene: Scene, print_scale: tuple[float, float]) -> Scene:
    """The scene with a piece printed larger or smaller, hung up at the same middle; piece mm stay the sheet's own."""
    if print_scale == (1.0, 1.0):
        return scene
    if not isinstance(scene, MeshScene):
        raise Refused("a scene with a mesh for a print of another size", "one of pictures", "leave --print-scale out")
    placement, scale = scene.placement, np.array(print_scale)
    middle = np.array(placement.size_mm) / 2
    about = np.eye(4)
    about[[0, 1], [0, 1]] = scale
    about[:2, 3] = middle - scale * middle
    vertices = placement.world(middle + (placement.piece_mm - middle) * scale)
    frame = placement.world_from_piece @ about
    return replace(scene, placement=replace(placement, vertices_mm=vertices, world_from_piece=frame))


def take_photo(stage: Stage, piece: PiecePicture | None, conditions: Conditions, path: Path | BytesIO) -> None:
    """One photograph as a JPEG file of the drawn quality with the camera's focal length in its EXIF data."""
    photo_px = stage.scene.settings.camera.photo_px
    with torch.no_grad():
        picture = photograph(stage, piece, conditions, photo_px, jpeg=False)[0].permute(1, 2, 0)
    save_photo(picture, stage.scene, int(conditions.sensor.jpeg[0]), path)


def save_photo(picture: torch.Tensor, scene: Scene, quality: int, path: Path | BytesIO) -> None:
    """An H×W×3 sRGB picture as this scene's camera writes it."""
    photo_px, exif = scene.settings.camera.photo_px, Image.Exif()
    if isinstance(scene, MeshScene):  # of pictures nobody knows the focal length
        focal_px = scene.matrix_px(photo_px)[0, 0]
        details = exif.get_ifd(0x8769)
        details[0xA405] = round(focal_px * _FULL_FRAME_DIAGONAL_MM / np.hypot(*photo_px))  # FocalLengthIn35mmFilm
    Image.fromarray(_bytes(picture.cpu().numpy())).save(path, "JPEG", quality=quality, exif=exif)


def _truth(scene: Scene, manifest: Manifest | None, conditions: Conditions, print_scale) -> dict:
    """Where the page's millimetres fall in this photograph, and what it was taken under."""
    drawn: dict[str, Any] = {name: values[0].tolist() for name, values in fields_of(conditions).items()}
    drawn["print_scale"] = [scale * float(conditions.pose.printed_scale[0]) for scale in print_scale]
    if manifest is None:
        return {"homography_px_from_mm": None, "marker_corners_px": {}, "conditions": drawn}
    surface, homography = surface_of(manifest), _homography(scene, manifest, conditions)
    corners = {
        str(i): _seen_at(scene, manifest, conditions, corners_mm).tolist()
        for i, corners_mm in surface.corners_mm.items()
        if i in surface.piece_ids
    }
    return {
        "homography_px_from_mm": None if homography is None else geometry.normalized(homography).tolist(),
        "marker_corners_px": corners,
        "conditions": drawn,
    }


def _homography(scene: Scene, manifest: Manifest, conditions: Conditions) -> np.ndarray | None:
    """3×3 from page millimetres to pixels; None where the piece or the lens bends, and there is no such thing."""
    if isinstance(scene, MeshScene) and not (
        scene.placement.is_flat and (scene.camera is None or not scene.camera.bends)
    ):
        return None
    x, y, *_ = manifest.cut_mm
    piece_from_page = np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1.0]])
    return scene.piece_homographies(conditions, scene.settings.camera.photo_px)[0] @ piece_from_page


def _seen_at(scene: Scene, manifest: Manifest, conditions: Conditions, page_mm: np.ndarray) -> np.ndarray:
    """Pixels N×2 of page points N×2, through bent paper and a bent picture, too."""
    homography, photo_px = _homography(scene, manifest, conditions), scene.settings.camera.photo_px
    if homography is not None:
        return geometry.apply_homography(homography, page_mm)
    pose, world = scene.camera_from_print(conditions)[0], scene.placement.world(page_mm - manifest.cut_mm[:2])
    image = (world @ pose[:3, :3].T + pose[:3, 3]) @ scene.matrix_px(photo_px).T
    points = image[:, :2] / image[:, 2:]
    return points if scene.camera is None else lens.distort_points(points, scene.camera, photo_px)


def printer_of(run: Run, name: str | None) -> Printer:
    """The printer of that name or file; the scene's own where none is named."""
    if name is None:
        return load_printer(run.scene.settings.printer.profile, run.scene.base)
    return load_printer(name)


def _bytes(picture: np.ndarray) -> np.ndarray:
    return (picture.clip(0, 1) * 255 + 0.5).astype(np.uint8)


def write_json(path: Path, data: dict) -> None:
    """The data as indented JSON."""
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
