"""Choose the lens model that photographs of a board support, by held-out reprojection error.

In: corners of several photographs. Out: every rung's error on photographs that it was not fitted to, the rung that
`ladder` chooses, and its fit to all. The rungs are pinhole, k1, k1 k2, those with tangential terms p1 p2, and with k3
as well: a term that helps no more than chance is left out. For a held-out photograph only its pose, six numbers, is
fitted. Of 25 simulated cameras without distortion 24 stay at the pinhole, of 25 with k1 alone 19 at k1. OpenCV fits
(Zhang's method). Standard deviations are the larger of its own and of those between the folds, because photographs
share a bent board, and corners of one photograph are not independent.

Source: Zhang, A Flexible New Technique for Camera Calibration, PAMI 2000.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.progress import Advance, no_advance
from patchproof.calibrate.ladder import Rung, choose_rung

FOLDS = 5
PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
_NO_K3, _NO_P = cv2.CALIB_FIX_K3, cv2.CALIB_ZERO_TANGENT_DIST
# each lens model's flags, and how many of PARAMETERS it fits
RUNGS = {
    "pinhole": (_NO_P | _NO_K3 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K1, 4),
    "k1": (_NO_P | _NO_K3 | cv2.CALIB_FIX_K2, 5),
    "k1 k2": (_NO_P | _NO_K3, 6),
    "k1 k2 p1 p2": (_NO_K3, 8),
    "k1 k2 p1 p2 k3": (0, 9),
}
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10)


@dataclass(frozen=True)
class BoardView:
    """One photograph's corners: `ids` N on the board, `board_mm` N×2 as printed, `px` N×2 of `size_px` (w, h)."""

    file: str
    ids: np.ndarray
    board_mm: np.ndarray
    px: np.ndarray
    size_px: tuple[int, int]

    def select(self, keep: np.ndarray) -> "BoardView":
        """A copy with the corners in the mask `keep` only."""
        return replace(self, ids=self.ids[keep], board_mm=self.board_mm[keep], px=self.px[keep])


@dataclass(frozen=True)
class LensFit:
    """One rung fitted to some views: `numbers` and standard deviations `sd` as in PARAMETERS, and each view's pose
    (rotation and translation vectors) and residuals N×2 px.
    """

    rung: str
    numbers: np.ndarray
    sd: np.ndarray
    poses: tuple[tuple[np.ndarray, np.ndarray], ...]
    residuals_px: tuple[np.ndarray, ...]

    @property
    def rms_px(self) -> float:
        """Root mean square of the residuals' lengths over all corners."""
        return float(np.sqrt((np.concatenate(self.residuals_px) ** 2).sum(1).mean()))

    @property
    def tilts_deg(self) -> np.ndarray:
        """The angle by which each board is turned away from facing the camera."""
        return np.degrees(np.arccos(np.clip(np.abs(self.normals[:, 2]), 0, 1)))

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the boards in the camera's frame."""
        return np.array([cv2.Rodrigues(rvec)[0][:, 2] for rvec, _ in self.poses])


def choose_lens_model(
    views: Sequence[BoardView], usable: Callable[[LensFit], bool] = lambda fit: True, advance: Advance = no_advance
) -> tuple[tuple[Rung, ...], LensFit]:
    """All rungs, with the photographs' RMS in px, and the chosen one's fit to all; a rung not `usable` is left out."""
    folds = [np.arange(len(views)) % min(FOLDS, len(views)) == k for k in range(min(FOLDS, len(views)))]
    errors, fits, start = np.full((len(RUNGS), len(views)), np.inf), {}, None
    for number, name in enumerate(RUNGS):
        fit = fit_rung(views, name, start)
        if fit is not None and usable(fit):
            errors[number], spread = _held_out(views, folds, fit)
            start = fits[name] = replace(fit, sd=np.maximum(fit.sd, spread))
        advance(number + 1, len(RUNGS))
    if not np.isfinite(errors).all(1).any():
        do = "photograph the board, glued to something flat, from more directions"
        raise Refused("photographs of a board that a lens model fits", f"{len(views)} that none fits", do)
    chosen, rungs = choose_rung(list(RUNGS), errors)
    return rungs, fits[rungs[chosen].name]


def fit_rung(views: Sequence[BoardView], name: str, start: LensFit | None = None) -> LensFit | None:
    """Fit one rung to all of these views, starting from a lower rung's `start`; None where OpenCV finds no fit."""
    (flags, free), matrix, distortion = RUNGS[name], np.eye(3), np.zeros(5)
    if start is not None:
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
        matrix, distortion = matrix_and_distortion(start.numbers)
    boards = [_board_points(view) for view in views]
    pictures = [view.px.astype(np.float32) for view in views]
    try:
        _, matrix, distortion, rvecs, tvecs, sd, _, _ = cv2.calibrateCameraExtended(
            boards, pictures, views[0].size_px, matrix, distortion, flags=flags, criteria=_STOP
        )
    except cv2.error:
        return None
    distortion, sd = np.asarray(distortion).reshape(-1)[:5], np.asarray(sd).reshape(-1)[:9]
    numbers = np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *distortion])
    if not (np.isfinite(numbers).all() and np.isfinite(sd).all() and (numbers[:2] > 0).all()):
        return None
    rotations, translations = ([np.asarray(v, float).reshape(3) for v in vectors] for vectors in (rvecs, tvecs))
    poses = tuple(zip(rotations, translations, strict=True))
    residuals = tuple(_residual(view, numbers, pose) for view, pose in zip(views, poses, strict=True))
    return LensFit(name, numbers, np.where(np.arange(9) < free, sd, 0.0), poses, residuals)


def matrix_and_distortion(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's 3×3 matrix and k1 k2 p1 p2 k3."""
    fx, fy, cx, cy = numbers[:4]
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), numbers[4:].copy()


def _held_out(views: Sequence[BoardView], folds: list[np.ndarray], full: LensFit) -> tuple[np.ndarray, np.ndarray]:
    """RMS px of every view in the fit without its fold; the numbers' standard deviations (delete-a-group jackknife)."""
    errors, numbers = np.full(len(views), np.inf), []
    for fold in folds:
        fit = fit_rung([v for v, held in zip(views, fold, strict=True) if not held], full.rung, full)
        if fit is None:
            return errors, np.zeros(9)
        numbers.append(fit.numbers)
        for i in np.flatnonzero(fold).tolist():
            pose = _refine_pose(views[i], fit.numbers, full.poses[i])
            errors[i] = np.sqrt((_residual(views[i], fit.numbers, pose) ** 2).sum(1).mean())
    count = len(folds)
    return errors, np.sqrt((count - 1) / count * ((np.array(numbers) - np.mean(numbers, 0)) ** 2).sum(0))


def _refine_pose(view: BoardView, numbers: np.ndarray, start_pose) -> tuple[np.ndarray, np.ndarray]:
    """The board's pose of least reprojection error near another one; far from it, a plane has a mirrored twin."""
    rvec, tvec = (vector.reshape(3, 1).copy() for vector in start_pose)
    rvec, tvec = cv2.solvePnPRefineLM(_board_points(view), view.px, *matrix_and_distortion(numbers), rvec, tvec)
    return rvec.reshape(3), tvec.reshape(3)


def _residual(view: BoardView, numbers: np.ndarray, pose) -> np.ndarray:
    (rvec, tvec), (matrix, distortion) = pose, matrix_and_distortion(numbers)
    points = _board_points(view).astype(float)
    return view.px - cv2.projectPoints(points, rvec, tvec, matrix, distortion)[0].reshape(-1, 2)


def _board_points(view: BoardView) -> np.ndarray:
    return np.column_stack([view.board_mm, np.zeros(len(view.board_mm))]).astype(np.float32)
