"""Attacks on a network within an ε-ball around its input: FGSM and PGD.

In: a network, pictures N×3×S×S in [0, 1] of its input size, their labels, ε. Out: which pictures survive. Attacks work
on the network's own input; one on the photograph's pixels by at most ε would be no stronger, since downsampling
averages. On hardened pictures a saturated softmax leaves no gradient, and an overconfident network would pass for a
robust one. So losses come from float64 logits, their gradient is scaled before it goes back through a float32 network,
and a picture survives only if it does so under both the cross-entropy and a margin loss, from every start. Random
starts have fixed seeds. Left out on purpose: attacks without gradients.

Sources: Goodfellow et al., Explaining and Harnessing Adversarial Examples, ICLR 2015 (FGSM); Madry et al., Towards Deep
Learning Models Resistant to Adversarial Attacks, ICLR 2018 (PGD); Carlini and Wagner, Towards Evaluating the Robustness
of Neural Networks, 2017 (margin f6); Croce and Hein, Reliable Evaluation of Adversarial Robustness, ICML 2020 (worst
case over losses).
"""

from collections.abc import Callable, Iterator, Sequence

import torch
from torch import Tensor

Logits = Callable[[Tensor], Tensor]
PictureLoss = Callable[[Tensor, Tensor], Tensor]
PGD_STEPS = 40
PGD_STEP = 1 / 4  # of ε


def cross_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    """N cross-entropies in float64, whose gradient vanishes at margins of 745; in float32, at 103."""
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
    """Attack by one step: clip(x + ε sign ∇L)."""
    return (pictures + epsilon * _gradient(network, pictures, labels, loss).sign()).clamp(0, 1)


def pgd(
    network: Logits, pictures: Tensor, labels: Tensor, epsilon: float, loss: PictureLoss, steps: int = PGD_STEPS
) -> Iterator[Tensor]:
    """Yield the pictures after each of `steps` PGD steps, which start at the pictures themselves."""
    x = pictures
    for _ in range(steps):
        x = _moved(x, _gradient(network, x, labels, loss), pictures, epsilon, PGD_STEP)
        yield x


def _moved(x: Tensor, gradient: Tensor, pictures: Tensor, epsilon: float, step: float) -> Tensor:
    """One PGD step: clip(Π(x + `step` ε sign ∇L)), Π the projection onto the ε-ball around the pictures."""
    x = x.detach() + step * epsilon * gradient.sign()
    return torch.clamp(x, pictures - epsilon, pictures + epsilon).clamp(0, 1)


def survives_fgsm(network: Logits, pictures: Tensor, labels: Tensor, epsilon: float) -> Tensor:
    """N bool: correct before the attack and after a step along either loss's gradient."""
    alive = _predicts_label(network, pictures, labels)
    for loss in LOSSES:
        if len(rows := alive.nonzero()[:, 0]):
            attacked = fgsm(network, pictures[rows], labels[rows], epsilon, loss)
            alive[rows] = _predicts_label(network, attacked, labels[rows])
    return alive


def pgd_outcomes(
    network: Logits,
    pictures: Tensor,
    labels: Tensor,
    epsilon: float,
    steps: int = PGD_STEPS,
    step: float = PGD_STEP,
    restarts: int = 0,
) -> tuple[Tensor, Tensor]:
    """Attack along both losses, from the pictures and from `restarts` random starts; a lost picture stops.

    Returns N steps after which the cross-entropy attack from the picture itself has won (0: it was wrong before,
    steps + 1: never), and N bool: correct before any attack and after every step of all of them.
    """
    first = lost_at(network, pictures, labels, epsilon, cross_entropy, steps, step)
    alive = first > steps
    for number in range(restarts + 1):
        for loss in LOSSES[number == 0 :]:
            if len(rows := alive.nonzero()[:, 0]):
                start, generator = pictures[rows], torch.Generator().manual_seed(number)
                if number:  # one noise for all pictures, so that none depends on its company
                    noise = 2 * torch.rand(start.shape[1:], generator=generator) - 1
                    start = (start + epsilon * noise.to(start)).clamp(0, 1)
                alive[rows] = lost_at(network, pictures[rows], labels[rows], epsilon, loss, steps, step, start) > steps
    return first, alive


def lost_at(
    network: Logits,
    pictures: Tensor,
    labels: Tensor,
    epsilon: float,
    loss: PictureLoss,
    steps: int = PGD_STEPS,
    step: float = PGD_STEP,
    start: Tensor | None = None,
) -> Tensor:
    """N numbers of PGD steps after which a picture is first wrong; steps + 1 where it never is."""
    lost, rows = torch.full((len(pictures),), steps + 1), torch.arange(len(pictures))
    x = pictures if start is None else start
    for number in range(steps + 1):
        x = x.detach().requires_grad_(True)
        with torch.enable_grad():
            logits = network(x)
            wrong = ~is_correct(logits, labels[rows])
            lost[rows[wrong]] = number
            if number == steps or bool(wrong.all()):
                break
            gradient = torch.autograd.grad(balanced_loss([logits], [labels[rows]], loss), x)[0]
        x, rows = _moved(x, gradient, pictures[rows], epsilon, step)[~wrong], rows[~wrong]
    return lost


def balanced_loss(logits: Sequence[Tensor], labels: Sequence[Tensor], loss: PictureLoss) -> Tensor:
    """A scalar with the gradient of the networks' mean loss, scaled per picture so that float32 keeps it.

    `logits[m]` and `labels[m]` are network m's. The largest gradient of a picture's logits over all
    networks becomes 1: signs stay the same, and float32 does not round the gradient to 0.
    """
    with torch.enable_grad():
        leaves = [each.detach().double().requires_grad_(True) for each in logits]
        total = torch.stack([loss(leaf, truth).sum() for leaf, truth in zip(leaves, labels, strict=True)]).sum()
        slopes = torch.autograd.grad(total, leaves)
        largest = torch.stack([slope.abs().amax(1) for slope in slopes]).amax(0)
        largest = torch.where(largest > 0, largest, 1)
        pairs = zip(logits, slopes, strict=True)
        return torch.stack([(each * (slope / largest[:, None])).sum() for each, slope in pairs]).sum()


def _gradient(network: Logits, pictures: Tensor, labels: Tensor, loss: PictureLoss) -> Tensor:
    pictures = pictures.detach().requires_grad_(True)
    with torch.enable_grad():
        return torch.autograd.grad(balanced_loss([network(pictures)], [labels], loss), pictures)[0]


def _predicts_label(network: Logits, pictures: Tensor, labels: Tensor) -> Tensor:
    with torch.no_grad():
        return is_correct(network(pictures), labels)
