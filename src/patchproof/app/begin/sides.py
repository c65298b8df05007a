"""Pictures of an object from its six sides, with ground line, scale bar and piece; from all around; and sample views.

In: a stage with a mesh, with a piece on it or without. Out: `SideView`s at one scale; pictures at one scale from a ring
of directions, for a page that turns the object by a slider; the piece's gap as colors. The sides are those
of `patch.side`; front and back are along z, as in glTF's standard and after `object.up = "z"` turned the y of other
programs there. The ring is seen from far away, in even light, and from above or below if the piece is on top or below.
Sample views are drawn from the train stream as optimizing draws them, and have the networks' answers beside them.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np
import torch
from torch import Tensor

from patchproof.base.geometry import UP, orbit, rect_border
from patchproof.base.validation import Side
from patchproof.classifier.network import Classifier
from patchproof.optimizer.pixels import as_pixels
from patchproof.render.photograph import photograph
from patchproof.render.stage import Stage
from patchproof.reprints.plan_view import plan_picture
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PieceScene
from patchproof.scene.mesh_scene import MeshScene, require_mesh
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import Placement, SurfaceFrame, gap_limit_mm, side_frame

SIDE_NAMES: dict[Side, str] = {"+z": "front", "-z": "back", "-x": "left", "+x": "right", "+y": "top", "-y": "bottom"}
PICTURE_PX = 320  # along the longer side: 24 from all around take 0.8 s, at 400 px 1.1 s of a preview's 4.5
_ROOM = 1.12  # of the largest extent
_STEP_DEG = 15
_ABOVE_DEG, _STEEPEST_DEG = 20.0, 55.0
_BAR_SHARE = 0.35  # of the picture's width at most
# five colors of viridis, legible to the color-blind; and a color for no surface that is none of them
RAMP_RGB = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
NO_SURFACE_RGB = (230, 0, 90)
_VIEWS, _TOP = 8, 5
_LEAST_PX = 200  # of a view's side: people see little in smaller ones
_EDGE_POINTS = 8  # bent paper has bent edges


@dataclass(frozen=True)
class SideView:
    """The object seen straight from one side, a square of `PICTURE_PX`."""

    side: Side
    name: str
    picture: np.ndarray  # uint8
    ground_px: float | None  # row of the ground under an upright view
    bar_mm: float
    bar_px: float
    holds_piece: bool  # True for the side that the piece faces


def side_views(stage: Stage) -> tuple[SideView, ...]:
    """Render a stage's object from all six sides, front first, the piece colored by its gap."""
    scene = require_mesh(stage.scene)
    half_mm = _ROOM * float(np.abs(_points_mm(scene)).max())
    bar_mm = round_length(2 * half_mm * _BAR_SHARE)
    bar_px = bar_mm / (2 * half_mm) * PICTURE_PX
    ground_px = PICTURE_PX * (0.5 - float(scene.mesh.vertices[:, 1].min()) / 2 / half_mm)
    holder = side_of(scene.placement.normal) if isinstance(scene, PatchScene) else None
    return tuple(
        SideView(side, name, picture, None if side[1] == "y" else ground_px, bar_mm, bar_px, side == holder)
        for side, name in SIDE_NAMES.items()
        for picture in [_picture(stage, side, half_mm)]
    )


def turntable(stage: Stage, on_piece: np.ndarray | None) -> dict[int, np.ndarray]:
    """Render the object from a ring of directions, 180° down to -165° to the right of the side of the piece or of the
    scene's front: uint8 H×W×3 by degrees. From one to the next, what faces the camera moves to the right. `on_piece`
    are colors (uint8 h×w×3) of the scene's piece.
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
    return {azimuth: plan_picture(stage, frame, half_mm, PICTURE_PX, on_piece) for azimuth, frame in frames.items()}


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
    gaps, stops = placement.gaps_mm, np.linspace(0, gap_limit_mm(placement.size_mm), len(RAMP_RGB))
    channels = [np.interp(np.nan_to_num(gaps), stops, column) for column in np.array(RAMP_RGB, float).T]
    return np.where(np.isnan(gaps)[..., None], NO_SURFACE_RGB, np.stack(channels, -1).round()).astype(np.uint8)


def _points_mm(scene: MeshScene) -> np.ndarray:
    """The object's vertices and the piece's, which may overhang."""
    points = scene.mesh.vertices
    return np.concatenate([points, scene.placement.vertices_mm]) if isinstance(scene, PatchScene) else points


def _upright(toward: np.ndarray, like: SurfaceFrame) -> SurfaceFrame:
    """An upright frame whose normal is a direction, with the origin and extent of `like`."""
    right = np.cross(UP, toward)
    right /= np.linalg.norm(right)
    return SurfaceFrame(right, np.cross(toward, right), toward, like.origin_mm, like.extent_mm)


def _picture(stage: Stage, side: Side, half_mm: float) -> np.ndarray:
    scene, colors = require_mesh(stage.scene), None
    frame = side_frame(scene.mesh, side)
    if isinstance(scene, PatchScene) and (scene.placement.normals @ frame.normal).max() > 1e-6:
        colors = gap_colors(scene.placement)
    return plan_picture(stage, frame, np.array([half_mm, half_mm]), PICTURE_PX, colors)


@dataclass(frozen=True)
class NetworkAnswer:
    """A network's most likely labels of one picture with their confidences; `recognized` if it sees the target."""

    network: str
    labels: tuple[tuple[str, float], ...]
    recognized: bool


@dataclass(frozen=True)
class SampleView:
    """One view: uint8 S×S×3, and the piece's outline M×2 in its pixels (None if the piece is turned away)."""

    picture: np.ndarray
    outline_px: np.ndarray | None
    azimuth_deg: float
    elevation_deg: float
    distance_mm: float
    answers: tuple[NetworkAnswer, ...]


def sample_views(stage: Stage, classifiers: list[Classifier], indices: list[tuple[int, ...]]) -> tuple[SampleView, ...]:
    """Render 8 views of the bare object and classify them; `indices` are the target's in each network (empty: none)."""
    network_px = max(classifier.input_px for classifier in classifiers)
    side_px = network_px * math.ceil(_LEAST_PX / network_px)
    conditions = stage.scene.draw("select", _VIEWS)  # in which nothing is erased
    with torch.no_grad():
        pictures = photograph(stage, None, conditions, (side_px, side_px), jpeg=False)
        logits = [classifier.logits(pictures, stage.scene.boxes(conditions)) for classifier in classifiers]
    pose = conditions.pose
    return tuple(
        SampleView(
            picture=as_pixels(pictures[i]),
            outline_px=_outline(stage, conditions[[i]], side_px),
            azimuth_deg=float(pose.azimuth_deg[i]),
            elevation_deg=float(pose.elevation_deg[i]),
            distance_mm=float(pose.distance_mm[i]),
            answers=tuple(
                _answer(classifier, network_logits[i], target)
                for classifier, network_logits, target in zip(classifiers, logits, indices, strict=True)
            ),
        )
        for i in range(_VIEWS)
    )


def _answer(classifier: Classifier, logits: Tensor, target: tuple[int, ...]) -> NetworkAnswer:
    best = classifier.probabilities(logits[None])[0].topk(min(_TOP, len(classifier.labels)))
    labels = tuple((classifier.labels[index], share) for share, index in zip(*map(Tensor.tolist, best), strict=True))
    recognized = bool(target) and bool(classifier.recognized(logits[None], target)[0])
    return NetworkAnswer(Path(classifier.name).name, labels, recognized)


def _outline(stage: Stage, conditions: Conditions, side_px: int) -> np.ndarray | None:
    """The piece's cut line in pixels of the photograph's centered square; None if it is turned away."""
    scene = stage.scene
    if not isinstance(scene, PieceScene) or not scene.facing(conditions)[0]:
        return None
    border, photo_px = rect_border((0, 0, *scene.piece.size_mm), _EDGE_POINTS), np.array(scene.photo_px)
    points = (scene.piece_px(conditions, border) - (photo_px - photo_px.min()) / 2) * side_px / photo_px.min()
    return points if np.isfinite(points).all() else None
