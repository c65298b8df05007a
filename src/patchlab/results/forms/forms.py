"""The built-in network in other forms: `python forms.py` writes builtin.onnx and builtin.pt2, each with its card;
`module:forms.network` is it as a factory of one's own.

It asks for `pip install "patchproof[test]"`, which has onnx.
"""

from __future__ import annotations

import json
from pathlib import Path

import torch

from patchproof.classifier.builtin import INPUT_PX, load_builtin
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.network import Classifier


def network() -> Classifier:
    """The factory."""
    builtin = load_builtin()
    return classifier_of(builtin.network, INPUT_PX, builtin.labels, "module:forms.network")


def main() -> None:
    """Write both files into the working folder."""
    builtin, pictures = load_builtin(), (torch.rand(2, 3, INPUT_PX, INPUT_PX),)
    axes = {"input_names": ["photos"], "dynamic_axes": {"photos": {0: "n"}}, "dynamo": False}
    torch.onnx.export(builtin.network, pictures, "builtin.onnx", **axes)
    any_number = ({0: torch.export.Dim("n", min=1, max=64)},)
    torch.export.save(torch.export.export(builtin.network, pictures, dynamic_shapes=any_number), "builtin.pt2")
    card = json.dumps({"input_px": INPUT_PX, "labels": list(builtin.labels)})
    Path("builtin.json").write_text(card, encoding="utf-8")


if __name__ == "__main__":
    main()
