"""Render only the window of a photograph that shows the piece, at full resolution.

In: a stage and a view's conditions. Out: `RenderedWindow`: a stage whose camera sees that window at the same scale; the
rest of the photograph takes most of the time and shows no markers. Left out on purpose: false markers outside of the
window.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from patchproof.render.stage import Stage
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.conditions import Conditions
from patchproof.scene.patch_scene import PatchScene, require_patch

_MARGIN_SHARE, _MARGIN_PX, _BLOCK = 0.25, 32, 16  # of the margin around the piece; windows start at blocks of JPEG


@dataclass(frozen=True)
class RenderedWindow:
    """A part of a photograph: `size_px` pixels whose top left corner is `origin_px` of the photograph."""

    stage: Stage
    size_px: tuple[int, int]
    origin_px: tuple[int, int] = (0, 0)


def piece_window(stage: Stage, conditions: Conditions) -> RenderedWindow:
    """The window around the piece; the whole photograph if the lens distorts or the piece is hardly in it."""
    whole_px = stage.scene.photo_px
    whole = RenderedWindow(stage, whole_px)
    if not stage.scene.HAS_OBJECT or stage.camera is not None:
        return whole
    scene = require_patch(stage.scene)
    edge = np.linspace(0, 1, 9)
    grid = np.stack(np.meshgrid(edge, edge), -1).reshape(-1, 2) * scene.placement.size_mm
    points = scene.piece_px(conditions, grid)
    if not np.isfinite(points).all():
        return whole
    margin = _MARGIN_SHARE * np.ptp(points, axis=0).max() + _MARGIN_PX
    low = np.clip(np.floor((points.min(0) - margin) / _BLOCK) * _BLOCK, 0, None).astype(int)
    high = np.minimum(np.ceil((points.max(0) + margin) / _BLOCK).astype(int) * _BLOCK, whole_px)
    if (high - low < 64).any():  # almost outside of the picture
        return whole
    (left, top), (width, height) = low.tolist(), (high - low).tolist()
    return RenderedWindow(_window_stage(stage, scene, (left, top), (width, height)), (width, height), (left, top))


def paste_on_plain(part: np.ndarray, origin_px, whole_px: tuple[int, int]) -> np.ndarray:
    """A photograph with `part` at `origin_px` on its median color."""
    srgb, (x, y) = np.full((whole_px[1], whole_px[0], 3), np.median(part, (0, 1)).astype(np.uint8)), origin_px
    srgb[y : y + part.shape[0], x : x + part.shape[1]] = part
    return srgb


@dataclass(frozen=True)
class _WindowScene(PatchScene):
    """A scene whose camera sees a window of the picture at the same scale; its `photo_px` is the window's size."""

    whole_px: tuple[int, int] = (0, 0)
    origin_px: tuple[int, int] = (0, 0)

    def matrix_px(self, size_px: tuple[int, int]) -> np.ndarray:
        """The whole picture's matrix, counted from the window's corner."""
        matrix = super().matrix_px(self.whole_px).copy()
        matrix[:2, 2] -= self.origin_px
        return matrix


@dataclass(frozen=True)
class _WindowBackgrounds:
    whole: Backgrounds
    whole_px: tuple[int, int]
    origin_px: tuple[int, int]

    def picture(self, choice: np.ndarray, photo_px, size_px) -> np.ndarray:
        x, y = self.origin_px
        return self.whole.picture(choice, self.whole_px, self.whole_px)[y : y + size_px[1], x : x + size_px[0]]


def _window_stage(stage: Stage, scene: PatchScene, origin_px: tuple[int, int], size_px: tuple[int, int]) -> Stage:
    whole_px = scene.settings.camera.photo_px
    parts = {field.name: getattr(scene, field.name) for field in fields(PatchScene)}
    parts["settings"] = scene.settings.changed(camera={"photo_px": size_px})
    parts["backgrounds"] = _WindowBackgrounds(scene.backgrounds, whole_px, origin_px)
    return replace(stage, scene=_WindowScene(**parts, whole_px=whole_px, origin_px=origin_px))
