"""Calibrate a camera from photographs of a board: choose photographs and lens model, write a file that scenes can read.

In: photographs and a board. Out: `CameraCalibration`, and NAME.json in the form of calibration/cameras. All views come
from one camera in one state: the picture size, orientation and focal length that most photographs share, because a
phone may switch lenses between two photographs. Corners are saddle points, symmetric under half a turn, so neither blur
nor the tone curve shifts them. Photographs that cannot determine a camera are refused: too few, boards that all face
the same way (a plane's picture then hardly depends on the focal length), a focal length known to no better than 1 %.
The print's proportions matter, not its size: rulers that differ are typed in. A photograph that stands out was moved or
shows a bent board. Left out on purpose: fisheye lenses; how flat the board is, which only the residuals show.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from patchproof.base.color import photo_codes_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.output import check_file, write_json
from patchproof.base.progress import Advance, Progress, no_advance, no_progress
from patchproof.calibrate.ladder import Rung
from patchproof.calibrate.lens_ladder import PARAMETERS, BoardView, LensFit, choose_lens_model, fit_rung
from patchproof.channel.lens import Camera, check_camera
from patchproof.photo.detect import detect_markers, detector_settings, luminance
from patchproof.photo.exif import camera_state
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_photos, read_photo
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.blank import Board, load_board
from patchproof.sheets.markers import DICTIONARY, aruco_dictionary

MIN_CORNERS = 12  # in one photograph: a pose has six unknowns, twelve corners give twenty-four numbers
MIN_PHOTOS = 6
MIN_TURN_DEG = 10.0  # between the two boards that differ most; users are asked for tilts of 20 to 45°
MAX_FOCAL_SHARE = 0.01  # one standard deviation of the focal length
GOOD_COVERAGE = 0.75  # of the half diagonal; distortion is largest beyond it
_TRIAL_RUNG = "k1 k2"  # models any lens of the ladder well enough to find odd photographs
_MOST_UNEQUAL = 0.005  # of the focal lengths across and down, above four standard deviations
_MAX_RMS_PX = 1.0  # rms for a picture of 2 megapixels or less; sharp photographs of flat boards have 0.05 to 0.3
_ODD_PHOTO_RATIO, _ODD_CORNER_RATIO, _ODD_PX = 3.0, 5.0, 0.5  # ratios to the median error, above _ODD_PX


@dataclass(frozen=True)
class CameraCalibration:
    """A camera, the ladder with its fit, the views used, and reasons for photographs left out."""

    camera: Camera
    rungs: tuple[Rung, ...]
    fit: LensFit
    views: tuple[BoardView, ...]
    left_out: Mapping[str, str]

    @property
    def coverage(self) -> float:
        """The distance of the outermost corner from the picture's middle, as a share of the half diagonal."""
        middle = np.array(self.views[0].size_px) / 2
        return max(float(np.linalg.norm(v.px - middle, axis=1).max()) for v in self.views) / float(np.hypot(*middle))


def calibrate_camera(
    photos: str | Path,
    board: str | Path,
    out: str | Path,
    *,
    ruler_mm: tuple[float, float] | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> CameraCalibration:
    """Calibrate and write the camera file; `board` is a template or BOARD.json, `ruler_mm` its rulers as measured."""
    out = Path(out)
    if out.suffix.lower() != ".json":
        raise Refused("a file name that ends in .json", f'"{out}"', "name the camera CAMERA.json")
    check_file(out, overwrite)
    template = load_board(board)
    views, left_out, camera = find_boards(photos, template, ruler_mm, partial(progress, "find corners"))
    result = fit_camera(views, left_out, template, out.stem, camera, partial(progress, "lens models"))
    write_json(out, result.camera.model_dump())
    return result


def fit_camera(
    views: Sequence[BoardView],
    left_out: Mapping[str, str],
    board: Board,
    name: str,
    camera: str = "",
    advance: Advance = no_advance,
) -> CameraCalibration:
    """Fit the camera that took these views; refused where they cannot determine it. `camera` is its name in files."""
    _refuse_too_few(views, left_out)
    views, odd = _without_odd(views)
    left_out = {**left_out, **odd}
    _refuse_too_few(views, left_out)
    size_px = views[0].size_px
    rungs, fit = choose_lens_model(views, lambda fit: _is_usable(fit, size_px), advance)
    _refuse_undetermined(fit)
    about = f"{len(views)} photographs of board {board.sheet_id}" + (f", camera {camera}" if camera else "")
    parts = ", ".join(f"{n} {s:.2g}" for n, s in zip(PARAMETERS, fit.sd, strict=True) if s > 0)
    errors = f"standard deviations {parts}; {fit.rms_px:.2g} px rms are left; a board that is not flat is not in it"
    fitted = _camera(fit, name, size_px, about, errors)
    check_camera(fitted, "this calibration")
    return CameraCalibration(fitted, rungs, fit, tuple(views), left_out)


def calibration_lines(result: CameraCalibration) -> list[str]:
    """The result in a few lines for the terminal."""
    fit, camera = result.fit, result.camera
    # infinite where no fit to these photographs, or to parts of them, is usable
    steps = ", ".join(f"{rung.name} {rung.error:.3f}" for rung in result.rungs).replace(" inf", " not measured")
    lines = [
        f"lens: {fit.rung} (held-out error in px: {steps})",
        f"focal length {camera.fx:.1f} ± {fit.sd[0]:.1f} × {camera.fy:.1f} ± {fit.sd[1]:.1f} px "
        f"at {camera.image_px[0]} × {camera.image_px[1]}, middle {camera.cx:.1f} ± {fit.sd[2]:.1f}, "
        f"{camera.cy:.1f} ± {fit.sd[3]:.1f}",
        f"{len(result.views)} photographs leave {fit.rms_px:.3f} px rms; tilts {fit.tilts_deg.min():.0f} to "
        f"{fit.tilts_deg.max():.0f}°",
    ]
    lines += [f"left out: {file}: {reason}" for file, reason in result.left_out.items()]
    if abs(np.log(camera.fx / camera.fy)) > max(_MOST_UNEQUAL, 4 * float(np.hypot(*fit.sd[:2])) / camera.fx):
        lines.append("warning: pixels are hardly this far from square: measure both rulers, and use --ruler-mm")
    if result.coverage < GOOD_COVERAGE:
        lines.append(
            f"warning: the board's corners reach {result.coverage:.0%} of the way to the picture's corners; "
            "beyond, distortion is a guess: photograph the board there, too"
        )
    return lines


def find_boards(
    photos: str | Path, board: Board, ruler_mm: tuple[float, float] | None = None, advance: Advance = no_advance
) -> tuple[list[BoardView], dict[str, str], str]:
    """Read a folder's photographs: (views, reasons by the names of photographs left out, the camera's name). `ruler_mm`
    are the printed rulers (x, y) as measured.
    """
    paths, views, left_out, states = list_photos(photos), [], {}, []
    positions_mm = corner_positions_mm(board, ruler_mm)
    for number, path in enumerate(paths, 1):
        try:
            view, focal_px = run_limited(_read_view, path, board, positions_mm)
            views.append(view)
            states.append((view.size_px, *camera_state(path), focal_px and round(focal_px)))
        except PhotoRejected as rejection:
            left_out[path.name] = rejection.advice
        advance(number, len(paths))
    if not views:
        got = f"{len(paths)} that do not show it ({': '.join(next(iter(left_out.items())))})"
        do = "take them sharp and lit, not mirrored, or name the board with --board"
        raise Refused(f"photographs of the board {board.sheet_id}", got, do)
    common = Counter(states).most_common(1)[0][0]
    pairs = list(zip(views, states, strict=True))
    left_out |= {view.file: _other_state(state, common) for view, state in pairs if state != common}
    return [view for view, state in pairs if state == common], left_out, common[1]


def corner_positions_mm(board: Board, ruler_mm: tuple[float, float] | None = None) -> np.ndarray:
    """Inner corners M×2 by id, from the board's top-left corner, scaled to the rulers as measured."""
    column, row = np.meshgrid(np.arange(1, board.grid.columns), np.arange(1, board.grid.rows))
    nominal = np.column_stack([column.ravel(), row.ravel()]) * board.grid.square_mm
    return nominal if ruler_mm is None else nominal * (np.array(ruler_mm) / board.ruler_mm)


def _read_view(path: Path, board: Board, positions_mm: np.ndarray) -> tuple[BoardView, float | None]:
    photo = read_photo(path)
    ids, px, markers = find_corners(photo.srgb, board)
    if len(ids) < MIN_CORNERS or np.linalg.matrix_rank(positions_mm[ids] - positions_mm[ids].mean(0)) < 2:
        advice = f"{markers} markers and {len(ids)} corners of the board were read, {MIN_CORNERS} corners are needed"
        raise PhotoRejected("too_few_markers", len(ids), MIN_CORNERS, f"{advice}: show more of it, sharp")
    height, width = photo.srgb.shape[:2]
    return BoardView(path.name, ids, positions_mm[ids], px, (width, height)), photo.focal_px


def find_corners(srgb: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray, int]:
    """Find the board's inner corners in a picture: (ids N, pixels N×2, number of markers). Markers are searched for in
    linear light, where blurred paper does not grow over ink; corners need no such care.
    """
    dictionary = aruco_dictionary(DICTIONARY)
    quads, names, _ = detect_markers(photo_codes_from_srgb(luminance(srgb)), dictionary, detector_settings())
    none = np.zeros(0, int), np.zeros((0, 2)), len(quads)
    if names is None:
        return none
    grid = board.grid
    pattern = cv2.aruco.CharucoBoard((grid.columns, grid.rows), grid.square_mm, grid.marker_mm, dictionary)
    gray = cv2.cvtColor(srgb, cv2.COLOR_RGB2GRAY)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(pattern).detectBoard(gray, None, None, quads, names)
    if ids is None or len(ids) == 0:
        return none
    # OpenCV 4 gives N×1 and N×1×2, OpenCV 5 gives N and N×2
    return np.asarray(ids).reshape(-1), np.asarray(corners, float).reshape(-1, 2) + 0.5, len(quads)


def _other_state(state, common) -> str:
    """Describe the first difference of a photograph's camera state from the most common one."""
    names = "a picture of {0[0]} × {0[1]} px", "a camera {0!r}", "an orientation {0!r}", "a focal length of {0} px"
    name, own, most = next(each for each in zip(names, state, common, strict=True) if each[1] != each[2])
    do = "keep one camera, its picture size, zoom and lens, and hold it one way"
    return f"{name.format(own)} where most have {name.format(most)}: {do}"


def _refuse_too_few(views: Sequence[BoardView], left_out: Mapping[str, str]) -> None:
    if len(views) < MIN_PHOTOS:
        why = f" ({': '.join(next(iter(left_out.items())))})" if left_out else ""
        expected = f"at least {MIN_PHOTOS} photographs that show {MIN_CORNERS} corners of the board"
        got = f"{len(views)} of {len(views) + len(left_out)}{why}"
        raise Refused(expected, got, "take 15 or more, sharp, from different sides")


def _without_odd(views: Sequence[BoardView]) -> tuple[list[BoardView], dict[str, str]]:
    """Views without photographs, then without corners, that fit badly: moved, of a bent board, occluded."""
    remaining, odd = list(views), {}
    while len(remaining) >= MIN_PHOTOS and (fit := fit_rung(remaining, _TRIAL_RUNG)) is not None:
        errors = [np.linalg.norm(residual, axis=1) for residual in fit.residuals_px]
        typical = np.array([np.median(error) for error in errors])
        typical_px, worst = float(np.median(typical)), int(typical.argmax())
        if typical[worst] > max(_ODD_PHOTO_RATIO * typical_px, _ODD_PX):
            # only the worst is dropped, since an odd photograph spoils the others' fit, as does an odd corner
            miss = f"its corners miss by {typical[worst]:.2f} px where most miss by {typical_px:.2f}"
            odd[remaining.pop(worst).file] = f"{miss}: moved, or a bent board"
            continue
        farthest = max(float(error.max()) for error in errors)
        if farthest <= max(_ODD_CORNER_RATIO * typical_px, _ODD_PX):
            break
        remaining = [view.select(error < farthest / 2) for view, error in zip(remaining, errors, strict=True)]
        reason = "too few of its corners agree with the others: show more of the board, sharp"
        odd |= {view.file: reason for view in remaining if len(view.ids) < MIN_CORNERS}
        remaining = [view for view in remaining if len(view.ids) >= MIN_CORNERS]
    return remaining, odd


def _refuse_undetermined(fit: LensFit) -> None:
    turns = np.degrees(np.arccos(np.clip(fit.normals @ fit.normals.T, -1, 1))).max()
    share = max(fit.sd[0] / fit.numbers[0], fit.sd[1] / fit.numbers[1])
    if fit.rms_px > _MAX_RMS_PX * max(1.0, float(np.hypot(*fit.numbers[2:4])) / 1000):
        do = "use one zoom and no crops, glue the board to something flat, measure both of its rulers (--ruler-mm)"
        expected = "photographs of a flat board that a lens model explains"
        raise Refused(expected, f"residuals of {fit.rms_px:.1f} px rms", do)
    if turns < MIN_TURN_DEG or share > MAX_FOCAL_SHARE:
        focal = "a focal length known to"
        expected = f"boards turned against each other by {MIN_TURN_DEG:g}° and more, and {focal} {MAX_FOCAL_SHARE:.0%}"
        do = "photograph the board from 20 to 45° aside, from all sides"
        raise Refused(expected, f"{turns:.0f}° and {focal} {share:.1%}", do)


def _is_usable(fit: LensFit, size_px: tuple[int, int]) -> bool:
    try:
        check_camera(_camera(fit, "trial", size_px, "", ""), "a trial")
    except Refused:
        return False
    return True


def _camera(fit: LensFit, name: str, size_px: tuple[int, int], instrument: str, uncertainty: str) -> Camera:
    description = {"instrument": instrument, "uncertainty": uncertainty, "when": date.today().isoformat()}
    numbers = {n: round(float(v), 6) for n, v in zip(PARAMETERS, fit.numbers, strict=True)}
    return Camera.model_validate({"name": name, "method": "measured", "image_px": size_px} | description | numbers)
