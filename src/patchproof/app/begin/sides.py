"""Pictures of an object from its six sides, with ground line, scale bar and piece; from all around; and sample views.

In: a stage with a mesh, with a piece on it or without. Out: pictures of the sides at one scale; pictures at one scale
from a ring of directions, for a page that turns the object by a slider; the piece's gap as colors. The sides are those
of `patch.side`; front and back are along z, as in glTF's standard and after `object.up = "z"` turned the y of other
programs there. The ring is seen from far away, in even light, and from above or below if the piece is on top or below.
Sample views are drawn from the train stream as optimizing draws them, and have the networks' answers beside them.
"""

import math
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from patchproof.base.geometry import UP, orbit, rect_border
from patchproof.base.validation import Side
from patchproof.classifier.network import Classifier
from patchproof.optimizer.subject import as_pixels
from patchproof.render.photograph import photograph, plan_picture
from patchproof.render.stage import Stage
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PieceScene
from patchproof.scene.mesh_scene import MeshScene, require_mesh
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import Placement, SurfaceFrame, gap_limit_mm, side_frame

SIDE_NAMES: dict[Side, str] = {"+z": "front", "-z": "back", "-x": "left", "+x": "right", "+y": "top", "-y": "bottom"}
PICTURE_PX = 320  # along the longer side
_ROOM = 1.12  # of the largest extent
_STEP_DEG = 30
_ABOVE_DEG, _STEEPEST_DEG = 20.0, 55.0
_BAR_SHARE = 0.35  # of the picture's width at most
# five colors of viridis, legible to the color-blind; and a color for no surface that is none of them
RAMP_RGB = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
NO_SURFACE_RGB = (230, 0, 90)
_VIEWS, _TOP = 8, 5
_LEAST_PX = 200  # of a view's side: people see little in smaller ones
_EDGE_POINTS = 8  # bent paper has bent edges


def side_views(stage: Stage) -> tuple[dict[Side, np.ndarray], dict[str, float]]:
    """Render a stage's object straight from all six sides, front first, the piece colored by its gap: uint8 squares of
    `PICTURE_PX`; and their scale: a bar of `bar_mm` is `bar_px` long, the ground of upright views is at `ground_px`.
    """
    scene = require_mesh(stage.scene)
    half_mm = _ROOM * float(np.abs(_points_mm(scene)).max())
    bar_mm, px_per_mm, pictures = round_length(2 * half_mm * _BAR_SHARE), PICTURE_PX / (2 * half_mm), {}
    for side in SIDE_NAMES:
        frame, colors = side_frame(scene.mesh, side), None
        if isinstance(scene, PatchScene) and (scene.placement.normals @ frame.normal).max() > 1e-6:
            colors = gap_colors(scene.placement)
        pictures[side] = plan_picture(stage, frame, np.array([half_mm, half_mm]), PICTURE_PX, colors)
    ground_px = PICTURE_PX / 2 - float(scene.mesh.vertices[:, 1].min()) * px_per_mm
    return pictures, {"bar_mm": bar_mm, "bar_px": bar_mm * px_per_mm, "ground_px": ground_px}


def turntable(stage: Stage) -> dict[int, np.ndarray]:
    """Render the object from a ring of directions, 180° down to -150° to the right of the side of the piece or of the
    scene's front, the piece colored by its gap: uint8 H×W×3 by degrees. From one to the next, what faces the camera
    moves to the right.
    """
    scene = require_mesh(stage.scene)
    x, y, z = scene.normal
    front = np.array([x, 0.0, z]) if np.hypot(x, z) > 1e-3 else np.array([0.0, 0.0, 1.0])
    slope_deg = float(np.degrees(np.arcsin(np.clip(y, -1, 1))))
    elevation_deg = float(np.clip(_ABOVE_DEG + slope_deg, -_STEEPEST_DEG, _STEEPEST_DEG))
    ring = range(180, -180, -_STEP_DEG)
    frames = {azimuth: _upright(orbit(azimuth, elevation_deg, front), scene.frame) for azimuth in ring}
    points = _points_mm(scene)
    half_mm = _ROOM * np.max([np.abs(points @ np.stack([f.right, f.up], 1)).max(0) for f in frames.values()], axis=0)
    colors = gap_colors(scene.placement) if isinstance(scene, PatchScene) else None
    return {azimuth: plan_picture(stage, frame, half_mm, PICTURE_PX, colors) for azimuth, frame in frames.items()}


def side_of(direction: np.ndarray) -> Side:
    """The side whose normal is nearest to a direction of the world."""
    axis = int(np.abs(direction).argmax())
    return get_args(Side)[2 * axis + int(direction[axis] < 0)]


def round_length(most_mm: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(most_mm))
    return float(power * max(step for step in (1, 2, 5) if step * power <= most_mm * (1 + 1e-9)))


def gap_colors(placement: Placement) -> np.ndarray:
    """Color the piece's gaps, uint8 N×N×3: 0 to `gap_limit_mm` from dark to light, `NO_SURFACE_RGB` off the surface."""
    shares, stops = placement.gaps_mm / gap_limit_mm(placement.size_mm), np.linspace(0, 1, len(RAMP_RGB))
    channels = [np.interp(np.nan_to_num(shares), stops, column) for column in np.array(RAMP_RGB, float).T]
    colors = np.stack(channels, -1).round().astype(np.uint8)
    colors[np.isnan(placement.gaps_mm)] = NO_SURFACE_RGB
    return colors


def _points_mm(scene: MeshScene) -> np.ndarray:
    """The object's vertices and the piece's, which may overhang."""
    points = scene.mesh.vertices
    return np.concatenate([points, scene.placement.vertices_mm]) if isinstance(scene, PatchScene) else points


def _upright(toward: np.ndarray, like: SurfaceFrame) -> SurfaceFrame:
    """An upright frame whose normal is a direction, with the origin and extent of `like`."""
    right = np.cross(UP, toward)
    right /= np.linalg.norm(right)
    return SurfaceFrame(right, np.cross(toward, right), toward, like.origin_mm, like.extent_mm)


def sample_views(stage: Stage, classifiers: list[Classifier], indices: list[tuple[int, ...]]) -> list[dict[str, Any]]:
    """Render 8 views of the bare object and classify them; `indices` are the target's in each network (empty: none).

    A view has its `picture` (uint8 S×S×3), the piece's `outline_px` M×2 in it (None if the piece is turned away), the
    camera's place, and `answers`: by network its most likely `labels` with their confidences, and if it `recognized`
    the target.
    """
    network_px = max(classifier.input_px for classifier in classifiers)
    side_px = network_px * math.ceil(_LEAST_PX / network_px)
    conditions = stage.scene.draw("select", _VIEWS)  # in which nothing is erased
    with torch.no_grad():
        pictures = photograph(stage, None, conditions, (side_px, side_px), jpeg=False)
        logits = [classifier.logits(pictures, stage.scene.boxes(conditions)) for classifier in classifiers]
    places = {name: getattr(conditions.pose, name) for name in ("azimuth_deg", "elevation_deg", "distance_mm")}
    return [
        {
            "picture": as_pixels(pictures[i]),
            "outline_px": _outline(stage, conditions[[i]], side_px),
            **{name: float(values[i]) for name, values in places.items()},
            "answers": [_answer(*each) for each in zip(classifiers, [row[i] for row in logits], indices, strict=True)],
        }
        for i in range(_VIEWS)
    ]


def _answer(classifier: Classifier, logits: Tensor, target: tuple[int, ...]) -> dict[str, Any]:
    best = classifier.probabilities(logits[None])[0].topk(min(_TOP, len(classifier.labels)))
    labels = [(classifier.labels[index], share) for share, index in zip(*map(Tensor.tolist, best), strict=True)]
    recognized = bool(target) and bool(classifier.recognized(logits[None], target)[0])
    return {"network": Path(classifier.name).name, "labels": labels, "recognized": recognized}


def _outline(stage: Stage, conditions: Conditions, side_px: int) -> np.ndarray | None:
    """The piece's cut line in pixels of the photograph's centered square; None if it is turned away."""
    scene = stage.scene
    if not isinstance(scene, PieceScene) or not scene.facing(conditions)[0]:
        return None
    border, photo_px = rect_border((0, 0, *scene.piece.size_mm), _EDGE_POINTS), np.array(scene.photo_px)
    points = (scene.piece_px(conditions, border) - (photo_px - photo_px.min()) / 2) * side_px / photo_px.min()
    return points if np.isfinite(points).all() else None
