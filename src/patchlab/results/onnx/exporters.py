"""Networks by torch's two ONNX exporters, read by patchproof, beside onnxruntime's logits and torch's gradients.

`python exporters.py` measures every network that exporters.json lists and writes that file again; names behind it
measure these only: `python exporters.py timm:levit_128s`. It asks for `pip install "patchproof[models,lab]"` and
onnxruntime. Weights are as initialized, pictures are noise. A network that the exporter cannot write, or patchproof
does not read, is stored with the sentence. Where a gradient in float32 is far from torch's, which a ReLU's or a pool's
kink near a value does, both are computed in float64 too.
"""

import json
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from patchproof.networks.bounds import UnsupportedNetwork
from patchproof.networks.graph import Program
from patchproof.networks.onnx_file import read_onnx

STORED = Path(__file__).parent / "exporters.json"
FAR = 1e-3  # of the largest gradient


class Means(nn.Module):
    """The mean logits of a segmentation."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S → N×K."""
        return self.network(photos)["out"].mean((2, 3))


def make(name: str) -> tuple[nn.Module, int]:
    """The network and the side of its pictures, 128 or what it asks for."""
    library, architecture = name.split(":")
    torch.manual_seed(0)
    if library in ("timm", "short"):  # short: one block in a stage, where that can be asked for
        import timm

        for sizes in ({"depths": (1,) * 4}, {"layers": (1,) * 4}, {"depth": 1}, {"depths": (1,) * 3}, {}):
            with suppress(Exception):  # each architecture has words of its own
                network = timm.create_model(architecture, num_classes=40, **sizes if library == "short" else {}).eval()
                break
        for weights in network.parameters():  # mixers begin with a last layer of zeros
            if weights.ndim > 1 and not weights.any():
                nn.init.normal_(weights, std=0.02)
        with suppress(Exception):  # of networks that take pictures of one size
            network(torch.rand(1, 3, 128, 128))
            return network, 128
        return network, network.default_cfg["input_size"][1]
    from torchvision.models import get_model

    segments = {"weights_backbone": None} if library == "seg" else {}
    network = get_model(architecture, weights=None, num_classes=40, **segments)
    side = 224 if architecture in ("maxvit_t", "vit_b_32") else 128
    return (Means(network) if segments else network).eval(), side


def answers(network: nn.Module, photos: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Logits, and the gradient of a weighted sum of them."""
    photos = photos.clone().requires_grad_()
    logits = network(photos)
    (gradient,) = torch.autograd.grad((logits * torch.linspace(-1, 1, logits.shape[1])).sum(), photos)
    return logits.detach().numpy(), gradient.numpy()


def in_float64(value: Any) -> Any:
    """A program, or what a step takes, with float32 made float64."""
    if isinstance(value, Program):
        for step in value.double().steps:
            step.arguments[:] = map(in_float64, step.arguments)
            step.keywords.update({name: in_float64(each) for name, each in step.keywords.items()})
            step.keywords.update({"to": 11} if step.keywords.get("to") == 1 else {})
        return value
    return value.double() if isinstance(value, Tensor) and value.dtype == torch.float32 else value


def measure(name: str, exporter: str) -> dict[str, Any]:
    """The largest differences, as shares of the largest logit and of the largest gradient; or what went wrong."""
    import onnxruntime

    network, side = make(name)
    photos = torch.rand(2, 3, side, side)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.onnx"
        any_number = {"input_names": ["x"], "dynamic_axes": {"x": {0: "n"}}, "dynamo": False}
        if exporter == "dynamo":
            any_number = {"dynamic_shapes": ({0: torch.export.Dim("n", max=99)},), "dynamo": True}
        try:
            torch.onnx.export(network, (photos,), str(path), **any_number)
        except Exception as error:  # the exporter may raise anything
            return {"not_written": f"{type(error).__name__}: {error}".splitlines()[0][:200]}
        session = onnxruntime.InferenceSession(str(path))
        theirs = session.run(None, {session.get_inputs()[0].name: photos.numpy()})[0]
        try:
            program, *_ = read_onnx(path.read_bytes(), lambda location: (Path(folder) / location).read_bytes())
            logits, gradient = answers(program, photos)
        except (UnsupportedNetwork, ValueError, RuntimeError) as error:
            return {"refused": str(error)[:200]}
    _, torchs = answers(network, photos)
    pairs = {"logits_onnxruntime": (logits, theirs), "gradient_torch": (gradient, torchs)}
    if np.abs(gradient - torchs).max() > FAR * np.abs(torchs).max():
        both = [answers(each, photos.double())[1] for each in (in_float64(program), network.double())]
        pairs["gradient_torch_float64"] = (both[0], both[1])
    return {word: _difference(*pair) for word, pair in pairs.items()}


def _difference(ours: np.ndarray, other: np.ndarray) -> float:
    return float(f"{np.abs(ours - other).max() / np.abs(other).max():.2g}")


def main(names: list[str]) -> None:
    """Measure and store."""
    stored = json.loads(STORED.read_text())
    for name in names or sorted(stored):
        stored[name] = {exporter: measure(name, exporter) for exporter in ("torchscript", "dynamo")}
        print(name, stored[name], flush=True)
        STORED.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
