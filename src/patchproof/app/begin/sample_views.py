"""Sample views of the bare object, and the networks' answers to them.

In: a scene and its classifiers. Out: `SampleView`s: pictures as the networks get them, drawn from the train stream as
optimizing draws them, the piece's outline (for people: it is not in the picture), and each network's five most likely
labels of the bare object.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.geometry import rect_border
from patchproof.classifier.network import Classifier
from patchproof.optimizer.pixels import as_pixels
from patchproof.render.photograph import photograph
from patchproof.render.stage import Stage
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PieceScene

_VIEWS, _TOP = 8, 5
_LEAST_PX = 200  # of a view's side: people see little in smaller ones
_EDGE_POINTS = 8  # bent paper has bent edges


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
    conditions = stage.scene.draw("train", _VIEWS)
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
