"""Make a run of a design from elsewhere: any picture, without optimization.

In: a picture (a file, or its pixels) and a scene with a printed piece. Out: the folder that `optimize` writes, but for
steps, views and checkpoint: the design, a promise beside its controls, and in run.json what was imported. A picture is
read like a photograph, and its pixels are printed unchanged, those of a coarse picture as blocks; only one of more than
`MAX_DESIGN_PX` is reduced. What paper and cameras lose of it is reported and not corrected. The sheet id depends on the
design, so that photographs of several designs on one scene are told apart by their markers.
Left out on purpose: cropping and padding, which make another design; textures; the search for a place; resuming.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.input import hash_file, is_file
from patchproof.base.output import check_folder, new_folder
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.base.settings import NO_PAGE, named_paths
from patchproof.base.text import printable
from patchproof.base.validation import summarize_names
from patchproof.classifier.network import Classifier
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import PromiseOptions
from patchproof.optimizer.run import RUN_FILE_PATTERNS, Run, finish_run, resolve_scene
from patchproof.optimizer.subject import from_pixels
from patchproof.photo.detect import find_markers
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.sheets.manifest import design_sha256
from patchproof.sheets.piece import Piece, marker_image

MIN_DESIGN_PX = 32  # of the shorter side; our own designs have no fewer either
MAX_DESIGN_PX = 1024  # of the longer side: a manifest carries the pixels, and 12 megapixels show about as many
MAX_STRETCH = 0.02  # of one side relative to the other; paper and rulers may differ by more
OUT_OF_GAMUT = 2.0  # ΔE00 that is just visible side by side
VISIBLE_DETAIL_RATIO = 2.0  # times the closest photograph's resolution; finer detail is lost on any camera of the scene
_NO_TEXTURE = 'leave patch.kind out, or "patch"'
_FLAT_MODULE_PX = 8  # pixels per module of the flat piece in which markers are searched for


def import_patch(
    picture: str | Path | np.ndarray,
    scene: str | Path | Scene,
    out: str | Path,
    *,
    as_printed: tuple[float, float] | None = None,
    models: Sequence[str | Classifier] | None = None,
    seed: int | None = None,
    promise: PromiseOptions = PromiseOptions(),
    compute: Compute = Compute(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Run:
    """Make a run of a picture that was made elsewhere, and promise its rate.

    Args:
        picture: a file, or uint8 H×W×3 sRGB; its proportions are the piece's within 2 %.
        scene: a scene with a printed piece, or the path of a scene file.
        out: the run's folder, new or empty.
        as_printed: width and height in mm of a print that exists: it has no page and no markers.
        models, seed, promise, compute, overwrite: as in `optimize`.
        progress: called with the stage "promise" (views).

    Raises:
        Refused: where the picture does not fit the piece, or where the piece's markers could not be read beside it.
    """
    out, compute = Path(out), compute.without("import_patch", cluster=True)
    check_folder(out, RUN_FILE_PATTERNS, overwrite, inputs=(picture, scene))
    file, sha256, pixels, said = _read_picture(picture)
    tables: dict[str, dict[str, Any]] = {}
    if as_printed is not None:  # in place of the scene's own piece, which need not fit
        tables["patch"] = dict(zip(("width_mm", "height_mm"), as_printed, strict=True))
        tables["sheet"] = {"template": NO_PAGE, "markers": False}
    scene = require_piece(resolve_scene(scene, seed, **tables), _NO_TEXTURE)
    fitted, scene = fit_to_piece(pixels, scene), scene.for_design(sha256)
    problem = set_problem(scene, compute.device, models, jobs=compute.jobs)
    problem = replace(problem, subject=replace(problem.patch, design_px=fitted.shape[1::-1]))
    design = problem.patch.pixels(from_pixels(fitted, problem.device))
    record: dict[str, Any] = {"file": file, "sha256": sha256} | _import_record(problem, pixels, fitted, design)
    with new_folder(out, RUN_FILE_PATTERNS, overwrite, named_paths(scene.settings, scene.base).values()) as folder:
        run = finish_run(problem, design, folder, promise, progress, record | {"notes": (*said, *record["notes"])})
    return replace(run, folder=out)


def fit_to_piece(pixels: np.ndarray, scene: PieceScene) -> np.ndarray:
    """A picture uint8 H×W×3 as a design of the scene's piece, reduced if it is large; refused if of another shape."""
    height, width = pixels.shape[:2]
    width_mm, height_mm = scene.piece.size_mm
    if min(width, height) < MIN_DESIGN_PX:
        expected = f"a picture of {MIN_DESIGN_PX} pixels or more along its shorter side"
        raise Refused(expected, f"{width} × {height}", "enlarge it yourself, and look at the result")
    ratio = (width / height) / (width_mm / height_mm)
    if max(ratio, 1 / ratio) > 1 + MAX_STRETCH:
        expected = f"a picture with the proportions of the piece ({width_mm:g} × {height_mm:g} mm)"
        raise Refused(expected, f"{width} × {height} pixels", _shape_advice(width, height, scene))
    if max(width, height) <= MAX_DESIGN_PX:
        return pixels
    size = tuple(round(side * MAX_DESIGN_PX / max(width, height)) for side in (width, height))
    light = LINEAR_FROM_CODE.astype(np.float32)  # plane by plane: all planes at once would take a gigabyte
    planes = [cv2.resize(light[pixels[..., i]], size, interpolation=cv2.INTER_AREA) for i in range(3)]
    return codes_from_srgb(srgb_from_linear(np.stack(planes, 2)))


def _shape_advice(width: int, height: int, scene: PieceScene) -> str:
    """Advice on how to give picture and piece the same shape."""
    width_mm, height_mm = scene.piece.size_mm
    if scene.settings.sheet.template == NO_PAGE:  # it is printed already
        return f"state its size as it was printed, such as --as-printed {width_mm:g}x{width_mm * height / width:.4g}"
    wide, high = round(height * width_mm / height_mm), round(width * height_mm / width_mm)
    options = [f"{do} it to {way(width, wide)} × {way(height, high)}" for do, way in (("crop", min), ("pad", max))]
    if scene.settings.object.photos is None:  # with photos the piece is as large as the blank
        options.append(f"set patch.height_mm = {width_mm * height / width:.4g}")
    return ", or ".join(options)


def _read_picture(picture: str | Path | np.ndarray) -> tuple[str, str, np.ndarray, tuple[str, ...]]:
    """(file name, SHA-256, uint8 sRGB H×W×3, what the file declares and was left aside) of a picture."""
    if isinstance(picture, np.ndarray):
        if picture.dtype != np.uint8 or picture.shape[2:] != (3,):
            got = f"{picture.dtype} {picture.shape}"
            raise Refused("a picture of uint8 H×W×3 pixels", got, "convert it to 8-bit RGB")
        return "an array", design_sha256(picture), picture, ()
    if not is_file(path := Path(picture)):
        raise Refused("a picture", f"no file at {path}", "check the path")
    try:
        photo = read_photo(path)
    except PhotoRejected as rejection:
        raise Refused("a picture that can be read", path.name, rejection.advice) from rejection
    return printable(path.name), hash_file(path), photo.srgb, photo.said


def _import_record(problem: Problem, picture: np.ndarray, fitted: np.ndarray, design: np.ndarray) -> dict[str, Any]:
    """The quality of a picture on its piece: as it came, as it fits the piece, and as it is printed; `out_of_gamut` is
    the share of its colors that the printer misses by more than `OUT_OF_GAMUT`, `delta_e00` the mean miss of all.
    """
    scene = require_piece(problem.scene)
    not_markers = ~marker_image(scene.piece, design.shape[1::-1])[1]
    errors = problem.printer.gamut_distance(from_pixels(design)[None])[0, 0].numpy()[not_markers]
    return {
        "picture_px": picture.shape[1::-1],
        "design_px": fitted.shape[1::-1],
        "dpi": round(MM_PER_INCH * _px_per_mm(fitted, scene), 1),
        "printer": problem.printer.name,
        "out_of_gamut": round(float((errors > OUT_OF_GAMUT).mean()), 4),
        "delta_e00": round(float(errors.mean()), 2),
        "notes": (*_resolution_notes(fitted, picture, scene, problem.network_px), *_marker_notes(design, scene.piece)),
    }


def _px_per_mm(design: np.ndarray, scene: PieceScene) -> float:
    """Pixels per mm in the coarser direction."""
    return min(px / mm for px, mm in zip(design.shape[1::-1], scene.piece.size_mm, strict=True))


def _resolution_notes(design: np.ndarray, picture: np.ndarray, scene: PieceScene, network_px: int) -> Iterator[str]:
    """Note a reduced picture, details finer than photographs show, or pixels coarser than the networks could see."""
    design_scale, text = _px_per_mm(design, scene), "{} than {}: {:.2g} pixels per mm beside {:.2g} in the closest view"
    photo_scale, network_scale = map(scene.closest_px_per_mm, (scene.photo_px, (network_px, network_px)))
    if design.shape != picture.shape:
        yield f"made smaller, to {design.shape[1]} × {design.shape[0]} pixels"
    if design_scale > VISIBLE_DETAIL_RATIO * photo_scale:
        yield text.format("finer", "photographs show", design_scale, photo_scale)
    if design_scale < network_scale:
        yield text.format("coarser", "what the network could see", design_scale, network_scale)


def _marker_notes(design: np.ndarray, piece: Piece) -> Iterator[str]:
    """Note a marker that is found in the flat piece besides its own; refused with more, or if its own are not found."""
    if not (ids := {marker.id for marker in piece.markers}):
        return
    factor = math.ceil(_FLAT_MODULE_PX / (piece.module_mm * design.shape[1] / piece.size_mm[0]))
    large = design.repeat(factor, 0).repeat(factor, 1)
    markers, reserved = marker_image(piece, large.shape[1::-1])
    flat = np.where(reserved[..., None], codes_from_srgb(markers), large)
    flat = np.pad(flat, ((_FLAT_MODULE_PX,) * 2, (_FLAT_MODULE_PX,) * 2, (0, 0)), constant_values=255)
    expected, do = "a design beside which the piece's markers can be read", "take squares like those of markers out"
    try:
        detected = find_markers(flat, ids)
    except PhotoRejected as rejection:
        raise Refused(expected, f"one that makes photographs too costly ({rejection.advice})", do) from rejection
    if missing := ids - detected.markers.keys():
        raise Refused(expected, f"one that hides {len(missing)} of {len(ids)} markers", do)
    others = [str(marker_id) for marker_id in (*detected.foreign, *detected.doubled)]
    if max(len(detected.foreign), len(detected.doubled)) > 1:
        raise Refused(expected, f"one that shows markers of its own ({summarize_names(others)})", do)
    for marker_id in others:
        yield f"the detector takes a part of it for marker {marker_id}"
