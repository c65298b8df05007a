"""The optimization problem: one subject (a patch, or the object's texture) on one stage, with one or more classifiers.

In: a scene, the names of its classifiers and its printer. Out: `Problem`, from which the loop, the promise and
`evaluate` get pictures of a design.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.fingerprint import refuse_other_inputs
from patchproof.base.text import brief
from patchproof.base.validation import refuse_untrusted
from patchproof.base.workers import use_threads
from patchproof.channel.printer import Printer, load_printer
from patchproof.classifier.labels import find_labels, refuse_different_entries
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.networks.batches import BatchedNetwork
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.subject import Loss, target_loss
from patchproof.render.pixels import PHOTO_SAMPLING, Appearance, TextureSampling
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import Views, relight_and_replace_background, render_views
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene, require_piece
from patchproof.scene.patch_scene import PatchScene

if TYPE_CHECKING:
    from patchproof.optimizer.texture import Texture

# Figures come from views of FIGURE_SCALE times the largest input's side, which a network reduces like photographs,
# and of MIN_FIGURE_PX at least, since each pixel takes one sample. Averaging textures over 0.8 of a pixel keeps them
# sharp; for a piece four taps give confidences within 0.004 (root mean square) of those with eight, and means within
# 0.0004. Training views have the network's own side, except for networks below MIN_TRAINING_PX.
FIGURE_SCALE, MIN_FIGURE_PX, MIN_TRAINING_PX = 1.4, 128, 192
TRAINING_SAMPLING = TextureSampling(taps=1, side=1.0, piece_taps=8)
FIGURE_SAMPLING = TextureSampling(taps=2, side=0.8, piece_taps=4)


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene on a device with its printer, classifiers and, per classifier, the label indices that count."""

    scene: Scene
    stage: Stage
    printer: Printer
    classifiers: tuple[Classifier, ...]
    indices: tuple[tuple[int, ...], ...]
    subject: "Patch | Texture"
    custom_loss: Loss | None  # in place of the goal's
    jobs: int = 1  # processes that share the views

    @cached_property
    def inputs(self) -> dict[str, str]:
        """Fingerprints of everything that results depend on, by settings key; a network's ends with its name."""
        return {**self.scene.inputs, **{f"target.models {each.name}": each.fingerprint for each in self.classifiers}}

    @property
    def training_px(self) -> int:
        """The side at which views are rendered for training and selection."""
        photo_px = self.scene.settings.camera.photo_px
        return self.figure_px if self.network_px < MIN_TRAINING_PX else min(self.network_px, *photo_px)

    @property
    def figure_px(self) -> int:
        """The side at which views are rendered for figures that people will read."""
        return min(max(math.ceil(FIGURE_SCALE * self.network_px), MIN_FIGURE_PX), *self.scene.settings.camera.photo_px)

    def losses(self, classifier: Classifier, logits: Tensor, indices: Sequence[int]) -> Tensor:
        """N losses to descend on, from a network's logits."""
        if self.custom_loss is not None:
            return self.custom_loss(logits, indices)
        return target_loss(classifier.odds(logits, indices), self.scene.settings.target.goal)

    def boxes(self, conditions: Conditions) -> np.ndarray | None:
        """The object's boxes in these views (`Scene.boxes`), if one of the networks uses them."""
        return self.scene.boxes(conditions) if any(c.LOOKS_AT_BOXES for c in self.classifiers) else None

    def see(self, appearance: Appearance, conditions: Conditions, side_px: int) -> Views:
        """Square views of these conditions, for this appearance and any other design in its place."""
        is_figure, is_small = side_px == self.figure_px, side_px < self.figure_px
        sampling = FIGURE_SAMPLING if is_figure else TRAINING_SAMPLING if is_small else PHOTO_SAMPLING
        return render_views(self.stage, appearance, conditions, (side_px, side_px), sampling)

    def see_again(self, views: Views, conditions: Conditions) -> Views:
        """Relight views and replace their backgrounds; overridden, as `see` is, by studies that simplify the model."""
        return relight_and_replace_background(views, conditions)

    @cached_property
    def start_appearance(self) -> Appearance:
        """The first design's appearance; in views rendered with it, any other design can be shown."""
        with torch.no_grad():
            return self.subject.appearance(self.subject.start())

    def with_piece_at(self, scene: PatchScene) -> "Problem":
        """A copy with the piece where `scene` has it; the object's tensors are shared."""
        subject = Patch(scene, self.printer, scene.design_px(self.network_px), self.device)
        return replace(self, scene=scene, stage=replace(self.stage, scene=scene), subject=subject)

    @property
    def patch(self) -> Patch:
        """The subject as a printed patch; refused for textures."""
        if isinstance(self.subject, Patch):
            return self.subject
        raise Refused("a printed patch", "the object's own texture", 'leave patch.kind out, or "patch"')

    @property
    def network_px(self) -> int:
        """The largest input size of the classifiers."""
        return max(classifier.input_px for classifier in self.classifiers)

    @property
    def device(self) -> torch.device:
        """The device of the tensors."""
        return self.stage.device


def set_problem(
    scene: Scene,
    device: str = "cpu",
    models: Sequence[str | Classifier] | None = None,
    loss: Loss | None = None,
    jobs: int = 1,
) -> Problem:
    """The problem of a scene; `models` replaces the scene's classifiers, `loss` that of its goal. On a CPU, `jobs`
    processes share its views.
    """
    check_device(device)
    settings = scene.settings
    names, least_score = models or scene.networks, settings.target.least_score
    if scene.received is not None and not models:
        refuse_untrusted(scene.received, settings.target.models)
    classifiers = tuple(load_classifier(name, scene.base, device).with_least_score(least_score) for name in names)
    indices = tuple(find_labels(c.labels, settings.target.label, settings.target.accept) for c in classifiers)
    refuse_different_entries([classifier.labels for classifier in classifiers], settings.target.label)
    printer = load_printer(settings.printer.profile, scene.base)
    stage = set_stage(scene, device)
    if loss is not None:
        _check_loss(loss, classifiers[0], indices[0], stage.device)
    if scene.HAS_PIECE:
        scene = require_piece(scene)  # a design no finer than the networks can see it
        design_px = scene.design_px(max(classifier.input_px for classifier in classifiers))
        subject = Patch(scene, printer, design_px, stage.device)
    else:
        from patchproof.optimizer.texture import Texture

        subject = Texture(scene, scene.object_canvas(), stage.device)
    jobs = jobs if stage.device.type == "cpu" else 1
    if jobs > 1:
        with use_threads(1):  # before forking, on one thread like the forked processes, since two round differently
            if stage.object is not None:
                stage.object.texels(reduced=True, fixed=scene.HAS_PIECE)
            for network in (classifier.network for classifier in classifiers if scene.HAS_PIECE):
                if isinstance(network, BatchedNetwork):
                    _ = network.cut  # computed on access
    problem = Problem(scene, stage, printer, classifiers, indices, subject, loss, jobs)
    if not models:
        refuse_other_inputs(scene.recorded, problem.inputs, f"the run of sheet {scene.sheet_id}", settings.model_dump())
    return problem


def check_device(device: torch.device | str) -> None:
    """Refuse a device that this torch lacks."""
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise Refused("a device that this torch can use", f"{device} ({reason})", "use --device cpu") from error


def _check_loss(loss: Loss, classifier: Classifier, indices: tuple[int, ...], device: torch.device) -> None:
    """Refuse a loss that fails, or that is not one differentiable number for each photograph."""
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(3, len(classifier.labels), generator=generator).to(device).requires_grad_()
    expected = f"loss(logits N×{len(classifier.labels)}, indices) to return N losses, a tensor of shape (3,) here"
    try:
        losses = loss(logits, indices)
    except Exception as error:  # the user's code may raise anything
        got = f"{type(error).__name__} ({error})"
        raise Refused(expected, got, "take the logits and the target's label indices") from error
    if not isinstance(losses, Tensor) or losses.shape != logits.shape[:1]:
        raise Refused(expected, brief(losses), "return one loss for each row: no mean, no sum over the rows")
    if losses.grad_fn is None:
        raise Refused(f"{expected}, with a gradient", "one without", "compute it with torch, without detach or no_grad")
