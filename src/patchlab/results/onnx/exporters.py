"""Networks by torch's two ONNX exporters, read by patchproof, beside onnxruntime's logits and torch's gradients.

`python exporters.py` measures every network that exporters.json lists and writes that file again; names behind it
measure these only: `python exporters.py timm:levit_128s`. It asks for `pip install "patchproof[models,lab]"` and
onnxruntime. Weights are as initialized.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import nn

from patchproof.networks.onnx_file import read_onnx

STORED = Path(__file__).parent / "exporters.json"


class Means(nn.Module):
    """The mean logits of a segmentation."""

    def __init__(self, network: nn.Module):
        super().__init__()
        self.network = network

    def forward(self, photos: torch.Tensor) -> torch.Tensor:
        """N×3×S×S → N×K."""
        return self.network(photos)["out"].mean((2, 3))


def make(name: str) -> tuple[nn.Module, int]:
    """The network and the side of its pictures."""
    library, architecture = name.split(":")
    torch.manual_seed(0)
    if library == "timm":
        import timm

        network = timm.create_model(architecture, num_classes=40)
        return network.eval(), network.default_cfg["input_size"][1]
    from torchvision.models import get_model

    segments = {"weights_backbone": None} if library == "seg" else {}
    network = get_model(architecture, weights=None, num_classes=40, **segments).eval()
    return (Means(network), 128) if segments else (network, 299 if architecture == "inception_v3" else 224)


def answers(network: nn.Module, photos: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Logits, and the gradient of a weighted sum of them."""
    photos = photos.clone().requires_grad_()
    logits = network(photos)
    (gradient,) = torch.autograd.grad((logits * torch.linspace(-1, 1, logits.shape[1])).sum(), photos)
    return logits.detach().numpy(), gradient.numpy()


def measure(name: str, exporter: str) -> dict[str, float]:
    """The largest differences, as shares of the largest logit and of the largest gradient."""
    import onnxruntime

    network, side = make(name)
    photos = torch.rand(2, 3, side, side)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "net.onnx"
        any_number = {"input_names": ["x"], "dynamic_axes": {"x": {0: "n"}}, "dynamo": False}
        if exporter == "dynamo":
            any_number = {"dynamic_shapes": ({0: torch.export.Dim("n")},), "dynamo": True}
        torch.onnx.export(network, (photos,), str(path), **any_number)
        session = onnxruntime.InferenceSession(str(path))
        theirs = session.run(None, {session.get_inputs()[0].name: photos.numpy()})[0]
        program, *_ = read_onnx(path.read_bytes(), lambda location: (Path(folder) / location).read_bytes())
    (logits, gradient), (_, torchs) = answers(program, photos), answers(network, photos)
    pairs = {"logits_onnxruntime": (logits, theirs), "gradient_torch": (gradient, torchs)}
    return {word: float(np.abs(ours - other).max() / np.abs(other).max()) for word, (ours, other) in pairs.items()}


def main(names: list[str]) -> None:
    """Measure and store."""
    stored = json.loads(STORED.read_text())
    for name in names or sorted(stored):
        stored[name] = {exporter: measure(name, exporter) for exporter in ("torchscript", "dynamo")}
        print(name, stored[name], flush=True)
        STORED.write_text(json.dumps(stored, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main(sys.argv[1:])
