"""Methods that make a design for the same piece with as many passes: ours, and alternatives.

In: a `Problem` with one network. Out: `MadeDesign`: the design's pixels, as printed, and its passes. A pass is one
picture that the network sees; pictures of training (forward and backward) and of selection (forward) count alike.

`ours` is the loop as the scene sets it, `sign` the loop with the signed steps of Pestana et al. `flat` does what a
tutorial does: it pastes the design at random places, sizes and angles into photographs of the bare object, and
descends by Adam. `art` gives the same photographs to the Adversarial Robustness Toolbox (Nicolae et al.,
arXiv:1807.01069), whose `AdversarialPatchPyTorch` follows Brown et al. (Adversarial Patch, 2017) likewise. The
photographs show conditions that `ours` trains under, too; designs are as large in them as in its views.
`unadversarial` is the loop with the renderer of Salman et al. (Unadversarial Examples, NeurIPS 2021): the object turns
before backgrounds under constant light, nothing is printed or photographed, and steps go along the gradient's sign.

Left out on purpose: printer, paper, light and perspective in `flat` and `art`, which is the comparison, and a selection
set, which neither has: both train with the passes that ours spends on it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchlab.paper.patch3d import design_shares
from patchlab.study.grid import views_per_network
from patchlab.study.trained_designs import best_design
from patchlab.validation.ablation import simplify_problem
from patchproof.app.plan.errors import scene_terms
from patchproof.base.errors import Refused
from patchproof.classifier.network import Classifier
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import in_chunks
from patchproof.render.photograph import expose
from patchproof.scene.patch_scene import require_patch

SIGN_STEP, UNADVERSARIAL_STEP = 0.01, 0.005  # as the papers' programs have them
# Best of 0.02, 0.05 and 0.1 for `flat` and, of 255 code values, 5 (ART's default), 13 and 25 for `art`: mean rates of
# two seeds of the demo in 512 views were 0.609, 0.579, 0.571 and 0.568, 0.597, 0.579, those of `ours` 0.806.
FLAT_STEP, ART_STEP = 0.02, 13.0
MAX_ROLL_DEG = 22.5  # of pasted designs, in either direction: Brown et al.'s published program, and ART's own default
MAX_PHOTOS = 256  # of the bare object, at most
_SIZE_QUANTILES = (0.05, 0.95)  # of the design's sizes in our views; pasted sizes lie between them


@dataclass(frozen=True)
class MadeDesign:
    """A design's pixels, uint8 H×W×3 as printed, and the number of passes that made it."""

    pixels: np.ndarray
    passes: int


def optimize_design(problem: Problem) -> MadeDesign:
    """Optimize with the scene's settings."""
    return MadeDesign(best_design(problem), pass_budget(problem))


def optimize_by_sign(problem: Problem, step: float = SIGN_STEP) -> MadeDesign:
    """Optimize with signed steps of the paper's size."""
    settings = problem.scene.settings.changed(optimize={"optimizer": "sign", "step_size": step})
    return optimize_design(replace(problem, scene=replace(problem.scene, settings=settings)))


def optimize_unadversarially(problem: Problem) -> MadeDesign:
    """Optimize with signed steps through geometry alone: even light, and neither printer nor camera."""
    terms = scene_terms(problem, problem.subject.start(), None)
    names = [term.name for term in terms if term.modeled and term.key.split(".")[0] in ("light", "printer", "camera")]
    return optimize_by_sign(simplify_problem(problem, " + ".join(names)), UNADVERSARIAL_STEP)


def paste_and_optimize(problem: Problem) -> MadeDesign:
    """Paste the design into photographs of the bare object, descend by Adam, and return the last design."""
    settings, photos, shares = problem.scene.settings.optimize, bare_photos(problem), paste_size_range(problem)
    rng, (classifier,), (indices,) = np.random.default_rng(problem.scene.seed), problem.classifiers, problem.indices
    design = problem.patch.start().requires_grad_()
    adam, steps = torch.optim.Adam([design], FLAT_STEP), pass_budget(problem) // settings.views
    for _ in range(steps):
        drawn = photos[rng.integers(0, len(photos), settings.views)]
        loss = problem.losses(classifier, classifier.logits(paste_designs(drawn, design, shares, rng)), indices).mean()
        (design.grad,) = torch.autograd.grad(loss, design)
        adam.step()
        with torch.no_grad():
            design.clamp_(0, 1)
    return MadeDesign(problem.patch.pixels(design), steps * settings.views)


def train_with_art(problem: Problem) -> MadeDesign:
    """Make the patch with ART as it is published: version 1.20 sums up the patch's gradients over all steps. It makes
    square patches only, which are then resized to the design's shape.
    """
    attack, wrapper = load_art()
    settings, (classifier,) = problem.scene.settings, problem.classifiers
    photos, (low, high) = bare_photos(problem), paste_size_range(problem)
    width, height = problem.patch.design_px
    epochs, side, labels = pass_budget(problem) // len(photos), max(width, height), len(classifier.labels)
    network = wrapper(  # in code values, as its examples are
        _CodeValueNetwork(classifier),
        torch.nn.CrossEntropyLoss(),
        tuple(photos.shape[1:]),
        labels,
        clip_values=(0, 255),
        device_type="cpu" if problem.device.type == "cpu" else "gpu",
    )
    before = np.random.get_state()
    with torch.random.fork_rng():  # ART draws from both libraries' global generators
        torch.manual_seed(problem.scene.seed)
        np.random.seed(problem.scene.seed)
        attacking = attack(
            network,
            rotation_max=MAX_ROLL_DEG,
            scale_min=min(low, 0.99 * high),  # ART refuses equal scales
            scale_max=high,
            learning_rate=ART_STEP,
            max_iter=epochs,
            batch_size=settings.optimize.views,
            patch_shape=(3, side, side),
            patch_type="square",
            targeted=settings.target.goal.sign > 0,
            verbose=False,
        )
        wanted = np.eye(labels, dtype=np.float32)[[problem.indices[0][0]] * len(photos)]
        codes, _ = attacking.generate(255 * photos.cpu().numpy(), wanted)
    np.random.set_state(before)
    design = F.interpolate(torch.tensor(codes)[None] / 255, (height, width), mode="bilinear", antialias=True)[0]
    return MadeDesign(problem.patch.pixels(design), epochs * len(photos))


METHODS: dict[str, Callable[[Problem], MadeDesign]] = {
    "ours": optimize_design,
    "sign": optimize_by_sign,
    "flat": paste_and_optimize,
    "art": train_with_art,
    "unadversarial": optimize_unadversarially,
}


def load_art() -> tuple[Any, Any]:
    """ART's attack and its wrapper of networks; refused if they cannot be imported."""
    try:
        attack, wrapper = import_module("art.attacks.evasion"), import_module("art.estimators.classification")
    except (ImportError, RuntimeError):  # the latter of a torchvision that was built for another torch
        do = 'pip install "patchproof[lab]", or choose another method'
        raise Refused("the Adversarial Robustness Toolbox", "none that can be imported", do) from None
    return attack.AdversarialPatchPyTorch, wrapper.PyTorchClassifier


class _CodeValueNetwork(torch.nn.Module):
    def __init__(self, classifier: Classifier):
        super().__init__()
        self._classifier = classifier

    def forward(self, codes: Tensor) -> Tensor:
        return self._classifier.logits(codes / 255)


def pass_budget(problem: Problem) -> int:
    """The passes of each method: as many as our training and selection take."""
    return views_per_network(problem.scene.settings.optimize)


def bare_photos(problem: Problem) -> Tensor:
    """N×3×S×S photographs of the bare object under the first training conditions, at the training size. N is at most
    `MAX_PHOTOS` and divides the passes into whole rounds, but for a rest.
    """
    passes = pass_budget(problem)
    count = passes // -(-passes // MAX_PHOTOS)
    conditions = problem.scene.draw("train", count)
    with torch.no_grad():
        parts = [expose(problem.see(None, part, problem.training_px), None) for part in in_chunks(conditions)]
    return torch.cat(parts)


def paste_size_range(problem: Problem) -> tuple[float, float]:
    """The range of the design's longer side as a share of the photograph's."""
    low, high = np.quantile(design_shares(require_patch(problem.scene, "a printed patch on a mesh")), _SIZE_QUANTILES)
    return min(float(low), 1.0), min(float(high), 1.0)


def paste_designs(photos: Tensor, design: Tensor, shares: tuple[float, float], rng: np.random.Generator) -> Tensor:
    """Paste a design 3×h×w into photographs N×3×S×S, wholly inside where it fits; differentiable in the design. Its
    longer side is a share of the photograph's, drawn between `shares`.
    """
    count, size = len(photos), np.array([design.shape[2], design.shape[1]])
    half = rng.uniform(*shares, (count, 1)) * size / size.max()  # photographs reach from -1 to 1
    angle = np.radians(rng.uniform(-MAX_ROLL_DEG, MAX_ROLL_DEG, count))
    turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], 1).reshape(-1, 2, 2)
    room = np.maximum(1 - (np.abs(turn) @ half[..., None])[..., 0], 0)
    middle = rng.uniform(-1, 1, (count, 2)) * room
    back = turn.transpose(0, 2, 1) / half[..., None]  # from the photograph to the design, which reaches from -1 to 1
    from_photo = torch.tensor(np.concatenate([back, -back @ middle[..., None]], 2)).to(photos)
    grid = F.affine_grid(from_photo, list(photos.shape), align_corners=False)
    layers = torch.cat([design, torch.ones_like(design[:1])]).expand(count, -1, -1, -1)
    layers = F.grid_sample(layers, grid, align_corners=False)  # 0 outside, so colors are multiplied by their share
    return photos * (1 - layers[:, 3:]) + layers[:, :3]
