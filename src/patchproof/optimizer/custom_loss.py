"""A user's own loss, tried on random logits before anything is computed with it."""

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.base.text import brief
from patchproof.classifier.network import Classifier
from patchproof.optimizer.subject import Loss

_ROWS = 3


def check_loss(loss: Loss, classifier: Classifier, indices: tuple[int, ...], device: torch.device) -> None:
    """Refuse a loss that fails, or that is not one differentiable number for each photograph."""
    generator = torch.Generator().manual_seed(0)
    logits = torch.randn(_ROWS, len(classifier.labels), generator=generator).to(device).requires_grad_()
    expected = f"loss(logits N×{len(classifier.labels)}, indices) to return N losses, a tensor of shape ({_ROWS},) here"
    try:
        losses = loss(logits, indices)
    except Exception as error:  # the user's code may raise anything
        got = f"{type(error).__name__} ({error})"
        raise Refused(expected, got, "take the logits and the target's label indices") from error
    if not isinstance(losses, Tensor) or losses.shape != logits.shape[:1]:
        raise Refused(expected, brief(losses), "return one loss for each row: no mean, no sum over the rows")
    if losses.grad_fn is None:
        raise Refused(f"{expected}, with a gradient", "one without", "compute it with torch, without detach or no_grad")
