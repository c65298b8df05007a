"""ONNX files for tests, written as text."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import onnx
from onnx import numpy_helper, parser

LABELS = ["red", "green", "blue", "none"]
SIZES = {
    "W": (4, 3, 3, 3),
    "D": (3, 1, 3, 3),
    "F": (4,),
    "S": (3,),
    "P": (3,),
    "C": (3, 1, 1),
    "M": (8, 5),
    "E": (12,),
    "Square": (8, 8),
}


def constants() -> dict[str, np.ndarray]:
    """Weights by name: P is positive, the rest is noise."""
    rng = np.random.default_rng(0)
    arrays = {name: rng.normal(size=size).astype("f") for name, size in SIZES.items()}
    return arrays | {"P": np.exp(arrays["P"]), "Zero": np.zeros((), "f"), "Two": np.full((), 2, "f")}


def model(body: str, opset: int = 20, batch: str = "N", sizes: str = "3,8,8") -> onnx.ModelProto:
    """A graph from x, float32 of N×3×8×8, to y: nodes as onnx writes them, in whose inputs `[1, 2]` is a constant, too,
    `[1, 2.5]` one of fractions, and capital letters are the arrays above.
    """
    lists: list[str] = []

    def named(inputs: re.Match) -> str:
        for numbers in re.findall(r"\[.*?\]", inputs[0]):
            kind = "floats" if "." in numbers else "ints"
            lists.append(f"list{len(lists)} = Constant<value_{kind}={numbers}>() ")
        count = iter(range(len(lists) - inputs[0].count("["), len(lists)))
        return re.sub(r"\[.*?\]", lambda _: f"list{next(count)}", inputs[0])

    nodes = re.sub(r"\([^()]*\)", named, body)
    head = f'<ir_version: 8, opset_import: ["" : {opset}]> g (float[{batch},{sizes}] x) => (float[K] y)'
    made = parser.parse_model(f"{head} {{ {''.join(lists)} {nodes} }}")
    used = {name for node in made.graph.node for name in node.input}
    made.graph.initializer.extend(
        numpy_helper.from_array(array, name) for name, array in constants().items() if name in used
    )
    return made


SMALL = "a = Conv<pads=[1,1,1,1]>(x, W, F) b = Relu(a) y = ReduceMean<keepdims=0, axes=[2,3]>(b)"


def small() -> onnx.ModelProto:
    """A convolution and a mean: N×4."""
    return model(SMALL, 13)


def save(
    folder: Path, made: onnx.ModelProto | bytes, labels=LABELS, name: str = "small", kind: str = "classifier"
) -> Path:
    """The file and its card."""
    path = folder / f"{name}.onnx"
    path.write_bytes(made if isinstance(made, bytes) else made.SerializeToString())
    path.with_suffix(".json").write_text(json.dumps({"input_px": 8, "labels": labels, "kind": kind}))
    return path
