"""Test a network before it is used, on three synthetic pictures, for faults that would falsify every later figure.

In: a Classifier. Out: nothing if all is well; refused if the network cannot be used (answers that depend on chance or
on the batch, no gradient, not for pictures in [0, 1]; what outputs.py finds); a warning if it may be right but looks
odd. Source of the idea: Croce et al., "Flags", github.com/fra31/auto-attack, checks.py.
"""

import warnings
from collections.abc import Iterator

import torch
from torch import Tensor

from patchproof.base.errors import Refused
from patchproof.classifier.network import NO_BOX_LOGIT, Classifier

# Logits differ by rounding when the batch does: 1e-6 of their spread in float32 here, 1e-3 with TF32. A dropout or a
# BatchNorm in training mode moves them by more than a hundredth.
MAX_DIFFERENCE = 5e-3  # of the spread
MIN_VARIATION = 1e-6  # of the spread: even untrained networks vary more between these pictures
USUAL_VARIATION = 1e-3  # trained networks vary by a tenth


def check_network(classifier: Classifier, device: torch.device | str = "cpu") -> None:
    """Refuse a network whose answers or gradients cannot be trusted; warn of one that looks odd."""
    from patchproof.classifier.outputs import check_shape, check_values

    photos = smooth_pictures(classifier.input_px).to(device)
    name = f"the network {classifier.name}"
    try:
        with torch.no_grad():
            output = classifier.network(photos)
            check_shape(output, classifier)
            again, alone, swapped = map(classifier.square_logits, (photos.clone(), photos[1:2], photos.flip(1)))
    except (Refused, Warning):  # a warning where they are errors
        raise
    except Exception as error:  # the network is the user's program and may raise anything
        reason = f"{type(error).__name__}: {error_summary(error)}"
        got = f"{name}, which fails on 3×3×{classifier.input_px}×{classifier.input_px} ({reason})"
        raise Refused("a network that takes N×3×S×S pictures", got, "check input_px and the export") from error
    logits = output[..., 4:].amax(1) if classifier.LOOKS_AT_BOXES else output
    if not torch.isfinite(logits).all() or torch.isnan(output).any():
        raise Refused("finite logits", f"NaN or infinity from {name}", "check its weights and its number format")
    check_values(classifier, photos, output)
    if classifier.LOOKS_AT_BOXES and float(logits.max()) <= NO_BOX_LOGIT:
        warnings.warn(f"{name} finds nothing in smooth pictures: its gradients were not tested", stacklevel=2)
        return
    spread = float(logits.max() - logits.min())
    do = "export it in evaluation mode, so that dropout and batch statistics are frozen"
    if float((logits - again).abs().max()) > MAX_DIFFERENCE * spread:
        raise Refused("the same logits for the same pictures", f"different logits on a second call from {name}", do)
    if float((logits[1:2] - alone).abs().max()) > MAX_DIFFERENCE * spread:
        got = f"different logits in a larger batch from {name}"
        raise Refused("logits that do not depend on the rest of the batch", got, do)
    if float((logits - logits.mean(0)).abs().max()) <= MIN_VARIATION * spread:
        do = "let it take sRGB in [0, 1], with its normalization inside"
        raise Refused("a network that tells pictures apart", f"{name}, whose logits are the same for all", do)
    _check_gradient(classifier, photos, name)
    for oddity in _oddities(logits, swapped, spread):
        warnings.warn(f"{name} {oddity}", stacklevel=2)


def _check_gradient(classifier: Classifier, photos: Tensor, name: str) -> None:
    """Check that the best logit's gradient at the pixels is finite and not zero."""
    photos, gradient = photos.clone().requires_grad_(True), None
    try:
        best = classifier.square_logits(photos).max(1).values.sum()
        if best.requires_grad:
            gradient = torch.autograd.grad(best, photos, allow_unused=True)[0]
    except (Refused, Warning):
        raise
    except Exception as error:  # such as that of weights made in inference mode
        got = f"{name}, whose gradient fails ({type(error).__name__}: {error_summary(error)})"
        raise Refused("a gradient from the logits to the pixels", got, "use a network that can be trained") from error
    if gradient is None or not torch.isfinite(gradient).all() or not (gradient.abs().amax((1, 2, 3)) > 0).all():
        got = f"{'none' if gradient is None else 'a zero or infinite one'} from {name}"
        raise Refused("a gradient from the logits to the pixels", got, "use a network of differentiable operations")


def _oddities(logits: Tensor, swapped: Tensor, spread: float) -> Iterator[str]:
    """Texts for warnings about outputs that are odd but can be right."""
    if float((logits - logits.mean(0)).abs().max()) <= USUAL_VARIATION * spread:
        yield "hardly tells pictures apart: does it take sRGB in [0, 1], with its normalization inside?"
    elif float((logits - swapped).abs().max()) <= USUAL_VARIATION * spread:
        yield "gives the same logits when red and blue are swapped: it may not see color"
    if (torch.softmax(logits.double(), 1).amax(1) > 1 - 1e-6).all():
        yield "is certain of pictures that show nothing: its gradients may be too small to optimize with"


def smooth_pictures(size_px: int) -> Tensor:
    """Three smooth colored pictures in [0, 1], 3×3×S×S, identical on every call."""
    coarse = torch.rand(3, 3, 6, 6, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.interpolate(coarse, (size_px, size_px), mode="bilinear", align_corners=False)


def error_summary(error: Exception) -> str:
    """The first line of an error's message, at most 200 characters."""
    return (str(error).strip().splitlines() or [""])[0][:200]
