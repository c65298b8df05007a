"""The built-in network in other forms: `python forms.py` writes builtin.onnx and its card; `module:forms.network` is
it as a factory of one's own.

It asks for `pip install "patchproof[lab]"`, which has onnx and onnxscript.
"""

import json
from pathlib import Path

from patchlab.training.fit import export_onnx
from patchproof.classifier.builtin import INPUT_PX, load_builtin
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.network import Classifier


def network() -> Classifier:
    """The factory."""
    builtin = load_builtin()
    return classifier_of(builtin.network, INPUT_PX, builtin.labels, "module:forms.network")


def main() -> None:
    """Write the file and its card into the working folder."""
    builtin = load_builtin()
    export_onnx(builtin.network, Path("builtin.onnx"), INPUT_PX)
    card = json.dumps({"input_px": INPUT_PX, "labels": list(builtin.labels)})
    Path("builtin.json").write_text(card, encoding="utf-8")


if __name__ == "__main__":
    main()
