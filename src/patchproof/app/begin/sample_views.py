"""What the camera sees before anything is on the object, and what the networks call it.

In: a scene and its classifiers. Out: `SampleView`s: pictures as the networks get them, drawn from the train stream as
optimizing draws them, with the piece's outline (a line for people: the networks do not see it) and each network's five
most likely labels of the bare object.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
_LEAST_PX = 200  # what is smaller is hard to look at
_STEPS = 8  # points along each edge: bent paper has bent edges


@dataclass(frozen=True)
class NetworkAnswer:
    """A network's most likely labels of one picture with their confidences, and whether the first is the target."""

    network: str
    labels: tuple[tuple[str, float], ...]
    recognized: bool


@dataclass(frozen=True)
class SampleView:
    """One view: uint8 S×S×3, the piece's outline M×2 in its pixels (none where the piece is turned away)."""

    picture: np.ndarray
    outline_px: np.ndarray | None
    azimuth_deg: float
    elevation_deg: float
    distance_mm: float
    answers: tuple[NetworkAnswer, ...]


def looks(
    stage: Stage, classifiers: Sequence[Classifier], indices: Sequence[tuple[int, ...]]
) -> tuple[SampleView, ...]:
    """`_VIEWS` of the bare object; `indices` are the target's in each network, empty where it is not known."""
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
                _answer(classifier, own[i], known)
                for classifier, own, known in zip(classifiers, logits, indices, strict=True)
            ),
        )
        for i in range(_VIEWS)
    )


def _answer(classifier: Classifier, logits: Tensor, known: tuple[int, ...]) -> NetworkAnswer:
    best = classifier.probabilities(logits[None])[0].topk(min(_TOP, len(classifier.labels)))
    labels = tuple((classifier.labels[index], share) for share, index in zip(*map(Tensor.tolist, best), strict=True))
    recognized = bool(known) and bool(classifier.recognized(logits[None], known)[0])
    return NetworkAnswer(Path(classifier.name).name, labels, recognized)


def _outline(stage: Stage, conditions: Conditions, side_px: int) -> np.ndarray | None:
    """Where the piece's cut line is in the photograph's centered square."""
    scene = stage.scene
    if not isinstance(scene, PieceScene) or not scene.facing(conditions)[0]:
        return None
    border, whole = rect_border((0, 0, *scene.piece.size_mm), _STEPS), np.array(scene.photo_px)
    points = (scene.piece_px(conditions, border) - (whole - whole.min()) / 2) * side_px / whole.min()
    return points if np.isfinite(points).all() else None
