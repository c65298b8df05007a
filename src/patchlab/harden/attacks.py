"""What attacks leave of a network's accuracy: FGSM and PGD in an ε-ball around what the network sees.

In: a network, pictures N×3×S×S in [0, 1] of its input size, their labels, ε. Out: which pictures survive. Attacks work
on the network's own input; one on the photograph's pixels by at most ε would be no stronger, since downsampling
averages. On pictures that were made easy a saturated softmax leaves no gradient, and a network that merely shouts would
pass for a robust one. So losses come from float64 logits, what they say of the logits is scaled before it goes back
through a float32 network, and a picture survives only where it does so under the cross-entropy and a margin loss.
Left out on purpose: random starts (results would differ by chance) and attacks without gradients.

Sources: Goodfellow et al., Explaining and Harnessing Adversarial Examples, ICLR 2015 (FGSM); Madry et al., Towards Deep
Learning Models Resistant to Adversarial Attacks, ICLR 2018 (PGD); Carlini and Wagner, Towards Evaluating the Robustness
of Neural Networks, 2017 (margin f6); Croce and Hein, Reliable Evaluation of Adversarial Robustness, ICML 2020 (worst
case over losses).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

Logits = Callable[[Tensor], Tensor]
PictureLoss = Callable[[Tensor, Tensor], Tensor]
PGD_STEPS = 40
PGD_STEP = 1 / 4  # of ε


def cross_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """N cross-entropies in float64, where their gradient vanishes at margins of 745, in float32 at 103."""
    return torch.nn.functional.cross_entropy(logits.double(), labels, reduction="none")


def margin(logits: Tensor, labels: Tensor) -> Tensor:
    """N margins max_{j≠y} z_j - z_y in float64: above 0 where the label has lost; their gradient never saturates."""
    logits = logits.double()
    others = logits.scatter(1, labels[:, None], -torch.inf)
    return others.amax(1) - logits.gather(1, labels[:, None])[:, 0]


LOSSES: tuple[PictureLoss, ...] = (cross_entropy, margin)


def is_correct(logits: Tensor, labels: Tensor) -> Tensor:
    """N bool: top-1 is the label."""
    return logits.argmax(1) == labels


def fgsm(network: Logits, pictures: Tensor, labels: Tensor, epsilon: float, loss: PictureLoss) -> Tensor:
    """clip(x + ε sign ∇L): one step."""
    return (pictures + epsilon * _gradient(network, pictures, labels, loss).sign()).clamp(0, 1)


def pgd(
    network: Logits,
    pictures: Tensor,
    labels: Tensor,
    epsilon: float,
    loss: PictureLoss,
    steps: int = PGD_STEPS,
    step: float = PGD_STEP,
) -> Iterator[Tensor]:
    """The pictures after each of `steps` steps, from x itself."""
    x = pictures
    for _ in range(steps):
        x = pgd_step(network, x, pictures, labels, epsilon, loss, step)
        yield x


def pgd_step(
    network: Logits,
    x: Tensor,
    pictures: Tensor,
    labels: Tensor,
    epsilon: float,
    loss: PictureLoss,
    step: float = PGD_STEP,
) -> Tensor:
    """x ← clip(Π(x + `step` ε sign ∇L)), Π onto the ε-ball round the pictures."""
    x = x + step * epsilon * _gradient(network, x, labels, loss).sign()
    return torch.clamp(x, pictures - epsilon, pictures + epsilon).clamp(0, 1)


def survives_fgsm(network: Logits, pictures: Tensor, labels: Tensor, epsilon: float) -> Tensor:
    """N bool: right, and still right after the step along either loss's gradient."""
    alive = _predicts_label(network, pictures, labels)
    for loss in LOSSES:
        if len(left := alive.nonzero()[:, 0]):
            alive[left] = _predicts_label(
                network, fgsm(network, pictures[left], labels[left], epsilon, loss), labels[left]
            )
    return alive


def survives_pgd(network: Logits, pictures: Tensor, labels: Tensor, epsilon: float, steps: int = PGD_STEPS) -> Tensor:
    """N bool: right, and still right wherever either loss leads on its way; what is lost goes no further."""
    alive = _predicts_label(network, pictures, labels)
    for loss in LOSSES:
        left, x = alive.nonzero()[:, 0], pictures[alive]
        for _ in range(steps):
            if not len(left):
                break
            x = pgd_step(network, x, pictures[left], labels[left], epsilon, loss)
            still = _predicts_label(network, x, labels[left])
            alive[left[~still]] = False
            left, x = left[still], x[still]
    return alive


ATTACKS = {"fgsm": survives_fgsm, "pgd": survives_pgd}


def balanced_loss(logits: Sequence[Tensor], labels: Sequence[Tensor], loss: PictureLoss) -> Tensor:
    """A number with the gradient of the networks' mean loss, scaled per picture so that none of it is lost.

    `logits[m]` and `labels[m]` are network m's. The gradient with respect to a picture's logits has 1 as its largest
    value over all networks: a sign does not change by that, and float32 does not round it to 0.
    """
    with torch.enable_grad():
        leaves = [own.detach().double().requires_grad_(True) for own in logits]
        total = torch.stack([loss(leaf, truth).sum() for leaf, truth in zip(leaves, labels, strict=True)]).sum()
        slopes = torch.autograd.grad(total, leaves)
        largest = torch.stack([slope.abs().amax(1) for slope in slopes]).amax(0)
        largest = torch.where(largest > 0, largest, 1)
        pairs = zip(logits, slopes, strict=True)
        return torch.stack([(own * (slope / largest[:, None])).sum() for own, slope in pairs]).sum()


def _gradient(network: Logits, pictures: Tensor, labels: Tensor, loss: PictureLoss) -> Tensor:
    pictures = pictures.detach().requires_grad_(True)
    with torch.enable_grad():
        return torch.autograd.grad(balanced_loss([network(pictures)], [labels], loss), pictures)[0]


def _predicts_label(network: Logits, pictures: Tensor, labels: Tensor) -> Tensor:
    with torch.no_grad():
        return is_correct(network(pictures), labels)
