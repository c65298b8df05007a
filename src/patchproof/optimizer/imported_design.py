"""A design that was made elsewhere as a run of its own: any picture takes the place of the search.

In: a picture (a file, or its pixels) and a scene with a printed piece. Out: the folder that `optimize` writes, but for
steps, views and checkpoint: the design, a promise beside its controls, and in run.json what was imported. A picture is
read like a photograph: upright, in sRGB, on white where it is see-through, in 8 bits. Its pixels are printed as they
are, those of a coarse picture as blocks, like ours; only one of more than `MAX_DESIGN_PX` is made smaller. What paper and
cameras lose of it is said and not mended. The sheet id is the design's own, so that photographs of several designs on
one scene are told apart by their markers.

Left out on purpose: cropping and padding, which make another design; textures; the search for a place, which tries
places with designs of its own. There is nothing to resume: a run that was stopped leaves nothing behind.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, codes_from_srgb, srgb_from_linear
from patchproof.base.compute import Compute
from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH
from patchproof.base.input import is_file
from patchproof.base.output import check_folder, new_folder
from patchproof.base.progress import Progress, no_progress
from patchproof.base.validation import summarize_names
from patchproof.classifier.network import Classifier
from patchproof.optimizer.pixels import from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import PROMISE_VIEWS, PromiseOptions
from patchproof.optimizer.run import RUN_FILE_PATTERNS, Run, finish_run, load_run, scene_of
from patchproof.photo.detect import find_markers
from patchproof.photo.read import list_photos, printable_name, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene.interface import PieceScene, Scene, require_piece
from patchproof.sheets.manifest import design_sha256
from patchproof.sheets.piece import Piece, marker_image

MIN_DESIGN_PX = 32  # of the shorter side; our own designs have no fewer either
MAX_DESIGN_PX = (
    1024  # of the longer side: a manifest carries the pixels, and a view of 12 megapixels shows about as many
)
MOST_STRETCH = 0.02  # of one side against the other: less than paper and rulers are asked for
OUT_OF_GAMUT = 2.0  # ΔE00 that is just visible side by side
FINER = 2.0  # times what the closest photograph shows: the rest is lost on any camera of the scene
_MODULE_PX = 8  # at which a piece's markers are looked for


@dataclass(frozen=True)
class ImportRecord:
    """Where a design comes from, and what becomes of it on this piece: file name, SHA-256 of its bytes (of an array's
    pixels), its size as it came, dots per inch as printed; the share of its colors that the printer misses by more than
    `OUT_OF_GAMUT`, and by how much it misses all of them in the mean (ΔE00); what else a reader should know.
    """

    file: str
    sha256: str
    picture_px: tuple[int, int]
    design_px: tuple[int, int]
    dpi: float
    printer: str
    out_of_gamut: float
    delta_e00: float
    notes: tuple[str, ...]


def import_patch(
    picture: str | Path | np.ndarray,
    scene: str | Path | Scene,
    out: str | Path,
    *,
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
        models, seed, promise, compute, overwrite: as in `optimize`.
        progress: called with the stage "promise" (views).

    Raises:
        Refused: where the picture does not fit the piece, or where the piece's markers could not be read beside it.
    """
    out, compute = Path(out), compute.without("import_patch", cluster=True)
    check_folder(out, RUN_FILE_PATTERNS, overwrite)
    (file, sha256, pixels), scene = _read(picture), _with_piece(scene, seed)
    fitted, scene = fit(pixels, scene), scene.of_design(sha256)
    problem = set_problem(scene, compute.device, models, jobs=compute.jobs)
    problem = replace(problem, subject=replace(problem.patch, design_px=fitted.shape[1::-1]))
    design = problem.patch.pixels(from_pixels(fitted, problem.device))
    record = _looked_at(problem, file, sha256, pixels, fitted, design)
    with new_folder(out, RUN_FILE_PATTERNS, overwrite) as folder:
        run = finish_run(problem, design, folder, promise, progress, asdict(record))
    return replace(run, folder=out)


def import_folder(
    folder: str | Path,
    scene: str | Path | Scene,
    out: str | Path,
    *,
    seed: int | None = None,
    promise: PromiseOptions = PromiseOptions(),
    compute: Compute = Compute(),
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> list[Run]:
    """A run `out`/NAME of every picture NAME.png (or another kind) in a folder, as `import_patch` makes it. All
    pictures are looked at before the first promise; with `resume` finished runs of theirs are kept.
    """
    scene, out, total = _with_piece(scene, seed), Path(out), promise.views or PROMISE_VIEWS
    runs = {path: out / printable_name(path.stem) for path in list_photos(folder)}
    if len(set(runs.values())) < len(runs):
        raise Refused("pictures whose names differ in more than their kind", f"others in {folder}", "rename them")
    made: dict[Path, Run] = {}
    for path, each in runs.items():
        _, sha256, pixels = _read(path)
        fit(pixels, scene)
        run = load_run(each) if resume and is_file(each / "run.json") else None
        if run is not None and run.details.get("imported", {}).get("sha256") == sha256:
            made[path] = run
        else:
            check_folder(each, RUN_FILE_PATTERNS, overwrite)
    for path, each in runs.items():
        if path not in made:
            before = len(made) * total
            made[path] = import_patch(
                path,
                scene,
                each,
                promise=promise,
                compute=compute,
                overwrite=overwrite,
                progress=lambda stage, done, _, before=before: progress(stage, before + done, len(runs) * total),
            )
    return [made[path] for path in runs]


def fit(pixels: np.ndarray, scene: PieceScene) -> np.ndarray:
    """A picture's pixels, uint8 H×W×3, as a design of the scene's piece: the same, or fewer of a large picture; refused
    where its shape is not the piece's, or it is too small for a design.
    """
    height, width = pixels.shape[:2]
    width_mm, height_mm = scene.piece.size_mm
    if min(width, height) < MIN_DESIGN_PX:
        do = "enlarge it yourself, and look at what comes of it"
        raise Refused(f"a picture of {MIN_DESIGN_PX} pixels or more along its shorter side", f"{width} × {height}", do)
    wider = (width / height) / (width_mm / height_mm)
    if max(wider, 1 / wider) > 1 + MOST_STRETCH:
        expected = f"a picture with the proportions of the piece ({width_mm:g} × {height_mm:g} mm)"
        raise Refused(expected, f"{width} × {height} pixels", _other_shape(width, height, scene))
    if max(width, height) <= MAX_DESIGN_PX:
        return pixels
    size = tuple(round(side * MAX_DESIGN_PX / max(width, height)) for side in (width, height))
    light = LINEAR_FROM_CODE.astype(np.float32)  # by planes: all of a picture's light at once would take a gigabyte
    planes = [cv2.resize(light[pixels[..., i]], size, interpolation=cv2.INTER_AREA) for i in range(3)]
    return codes_from_srgb(srgb_from_linear(np.stack(planes, 2)))


def _other_shape(width: int, height: int, scene: PieceScene) -> str:
    """How picture and piece come to the same shape."""
    width_mm, height_mm = scene.piece.size_mm
    cropped = min(width, round(height * width_mm / height_mm)), min(height, round(width * height_mm / width_mm))
    padded = max(width, round(height * width_mm / height_mm)), max(height, round(width * height_mm / width_mm))
    ways = [f"{do} it to {size[0]} × {size[1]}" for do, size in (("crop", cropped), ("pad", padded))]
    if scene.settings.object.photos is None:  # there the piece is as large as the blank's
        ways.append(f"set patch.height_mm = {width_mm * height / width:.4g}")
    return ", or ".join(ways)


def _with_piece(scene: str | Path | Scene, seed: int | None) -> PieceScene:
    return require_piece(scene_of(scene, seed), 'leave patch.kind out, or "patch"')


def _read(picture: str | Path | np.ndarray) -> tuple[str, str, np.ndarray]:
    """(file name, SHA-256, uint8 sRGB H×W×3) of a picture."""
    if isinstance(picture, np.ndarray):
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
            do = "convert it to 8-bit RGB"
            raise Refused("a picture of uint8 H×W×3 pixels", f"{picture.dtype} {picture.shape}", do)
        return "an array", design_sha256(picture), picture
    path = Path(picture)
    if not is_file(path):
        raise Refused("a picture", f"no file at {path}", "check the path")
    try:
        pixels = read_photo(path).srgb
    except PhotoRejected as cannot:
        raise Refused("a picture that can be read", printable_name(path.name), cannot.advice) from cannot
    with open(path, "rb") as file:
        return printable_name(path.name), hashlib.file_digest(file, "sha256").hexdigest(), pixels


def _looked_at(
    problem: Problem, file: str, sha256: str, picture: np.ndarray, fitted: np.ndarray, design: np.ndarray
) -> ImportRecord:
    """What is to be said of a picture: as it came, as it fits, and as it is printed."""
    scene = require_piece(problem.scene)
    free = ~marker_image(scene.piece, design.shape[1::-1])[1]
    missed = problem.printer.gamut_distance(from_pixels(design)[None])[0, 0].numpy()[free]
    return ImportRecord(
        file=file,
        sha256=sha256,
        picture_px=picture.shape[1::-1],
        design_px=fitted.shape[1::-1],
        dpi=round(MM_PER_INCH * _px_per_mm(fitted, scene), 1),
        printer=problem.printer.name,
        out_of_gamut=round(float((missed > OUT_OF_GAMUT).mean()), 4),
        delta_e00=round(float(missed.mean()), 2),
        notes=(*_resolution_notes(fitted, picture, scene, problem.network_px), *_marker_notes(design, scene.piece)),
    )


def _px_per_mm(design: np.ndarray, scene: PieceScene) -> float:
    """Of the coarser direction."""
    return min(px / mm for px, mm in zip(design.shape[1::-1], scene.piece.size_mm, strict=True))


def _resolution_notes(design: np.ndarray, picture: np.ndarray, scene: PieceScene, network_px: int) -> Iterator[str]:
    """Where the picture was made smaller, shows more than photographs can, or less than the networks could see."""
    own, beside = _px_per_mm(design, scene), "{} than {}: {:.2g} pixels per mm beside {:.2g} in the closest view"
    shown, seen = scene.closest_px_per_mm(scene.photo_px), scene.closest_px_per_mm((network_px, network_px))
    if design.shape != picture.shape:
        yield f"made smaller, to {design.shape[1]} × {design.shape[0]} pixels"
    if own > FINER * shown:
        yield beside.format("finer", "photographs show", own, shown)
    if own < seen:
        yield beside.format("coarser", "what the network could see", own, seen)


def _marker_notes(design: np.ndarray, piece: Piece) -> Iterator[str]:
    """Markers that the detector sees in the flat piece besides its own; refused where photographs would look like those
    of several sheets, or the piece's own are not all found.
    """
    ids = {marker.id for marker in piece.markers}
    finer = math.ceil(_MODULE_PX / (piece.module_mm * design.shape[1] / piece.size_mm[0]))
    large = design.repeat(finer, 0).repeat(finer, 1)
    markers, reserved = marker_image(piece, large.shape[1::-1])
    flat = np.where(reserved[..., None], codes_from_srgb(markers), large)
    flat = np.pad(flat, ((_MODULE_PX,) * 2, (_MODULE_PX,) * 2, (0, 0)), constant_values=255)
    expected, do = "a design beside which the piece's markers can be read", "take squares like those of markers out"
    try:
        seen = find_markers(flat, ids)
    except PhotoRejected as cannot:
        raise Refused(expected, f"one that makes photographs too costly ({cannot.advice})", do) from cannot
    if lost := ids - seen.markers.keys():
        raise Refused(expected, f"one that hides {len(lost)} of {len(ids)}", do)
    if max(len(seen.foreign), len(seen.doubled)) > 1:
        strange = summarize_names([str(each) for each in (*seen.foreign, *seen.doubled)])
        raise Refused(expected, f"one that shows markers of its own ({strange})", do)
    for each in (*seen.foreign, *seen.doubled):
        yield f"the detector takes a part of it for marker {each}"
