"""`file:NAME.onnx`: read an untrusted ONNX file without the library onnx.

In: its bytes, and a function that reads NAME.onnx.data, where exporters put large weights. Out: a Program of numbered
steps (graph.py), and how many pictures it takes; anything unsupported raises UnsupportedNetwork. Nothing of the file is
executed, and no text of it becomes a path: the path in a weight's "location" is not followed.
Left out on purpose: subgraphs (If, Loop), functions of the file, operators of other domains, sparse and quantized
weights, opsets before 13, which onnx.version_converter converts to newer ones.

Source: github.com/onnx/onnx, onnx.proto (IR version 13).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from patchproof.networks import bounds
from patchproof.networks.bounds import UnsupportedNetwork, checked_integer, quote
from patchproof.networks.graph import Program
from patchproof.networks.onnx_aten import AtenCalls, aten_calls
from patchproof.networks.onnx_operators import DTYPES, OPERATORS
from patchproof.networks.onnx_shapes import MAX_SIZES
from patchproof.networks.protobuf import BYTES, FLOAT, INT, TEXT, UNSUPPORTED, Schema, read_message
from patchproof.networks.steps import InputDevice, Step, ValueRef, mark_last_uses

OPSETS = (13, 28)
MAX_SCALARS = 8  # floats that stay on the CPU; a Resize has up to eight factors

_ENTRY: Schema = {1: ("key", TEXT, False), 2: ("value", TEXT, False)}
_TENSOR: Schema = {
    1: ("dims", INT, True),
    2: ("data_type", INT, False),
    3: ("segment", UNSUPPORTED, False),
    4: ("floats", BYTES, True),
    5: ("ints", INT, True),
    6: ("strings", UNSUPPORTED, False),
    7: ("longs", INT, True),
    8: ("name", TEXT, False),
    9: ("raw", BYTES, False),
    10: ("doubles", BYTES, True),
    11: ("unsigned", UNSUPPORTED, False),
    13: ("external", _ENTRY, True),
    14: ("place", INT, False),
}
_ATTRIBUTE: Schema = {
    1: ("name", TEXT, False),
    2: ("f", FLOAT, False),
    3: ("i", INT, False),
    4: ("s", TEXT, False),
    5: ("t", _TENSOR, False),
    6: ("a graph within the graph", UNSUPPORTED, False),
    7: ("floats", FLOAT, True),
    8: ("ints", INT, True),
    **{number: ("an attribute of an unusual kind", UNSUPPORTED, True) for number in (9, 10, 11, 14, 15, 21, 22, 23)},
}
_NODE: Schema = {
    1: ("input", TEXT, True),
    2: ("output", TEXT, True),
    4: ("op_type", TEXT, False),
    5: ("attribute", _ATTRIBUTE, True),
    7: ("domain", TEXT, False),
    8: ("overload", UNSUPPORTED, False),
}
_SIZE: Schema = {1: ("value", INT, False), 2: ("symbol", TEXT, False)}
_TYPE: Schema = {1: ("tensor", {1: ("kind", INT, False), 2: ("shape", {1: ("dim", _SIZE, True)}, False)}, False)}
_PLACE: Schema = {1: ("name", TEXT, False), 2: ("type", _TYPE, False)}
_GRAPH: Schema = {
    1: ("node", _NODE, True),
    5: ("initializer", _TENSOR, True),
    11: ("input", _PLACE, True),
    12: ("output", {1: ("name", TEXT, False)}, True),
    15: ("sparse weights", UNSUPPORTED, True),
}
_MODEL: Schema = {
    7: ("graph", _GRAPH, False),
    8: ("opset", {1: ("domain", TEXT, False), 2: ("version", INT, False)}, True),
    20: ("training steps", UNSUPPORTED, True),
    25: ("functions of its own", UNSUPPORTED, True),
}


def read_onnx(stored: bytes, read_data: Callable[[], bytes]) -> tuple[Program, int | None]:
    """The network, and the number of pictures it takes (None: any). `read_data` reads NAME.onnx.data, at most once."""
    model = read_message(stored, _MODEL)
    versions = [opset.get("version", 0) for opset in model.get("opset", []) if opset.get("domain", "") in _STANDARD]
    if len(versions) != 1 or not OPSETS[0] <= versions[0] <= OPSETS[1]:
        raise UnsupportedNetwork(f"opset {quote(versions)[1:-1]}, not one from {OPSETS[0]} to {OPSETS[1]}")
    return _GraphReader(model["graph"], _Weights(read_data)).read()


_STANDARD = ("", "ai.onnx")


class _Weights:
    """Reads tensors from their descriptions; each byte of the other file belongs to one tensor at most."""

    def __init__(self, read_data: Callable[[], bytes]):
        self.read_data, self.data, self.used_bytes, self.locations = read_data, b"", 0, set()

    def tensor(self, content: dict[str, Any]) -> Tensor:
        """Return the described tensor in memory of its own."""
        sizes = [checked_integer(size, 0, bounds.MAX_NUMBERS) for size in content.get("dims", [])]
        dtype, name = DTYPES.get(content.get("data_type", 0)), quote(content.get("name"))
        if dtype is None or len(sizes) > bounds.MAX_DIMENSIONS:
            raise UnsupportedNetwork(f"{name} of a type that is not supported")
        if "ints" in content or "longs" in content:
            values = torch.tensor(content.get("ints") or content["longs"], dtype=torch.int64).to(dtype)
            if dtype.is_floating_point:
                raise UnsupportedNetwork("bits of fractions in a list of integers")
        else:
            values = _from_bytes(self._bytes(content), dtype)
        if values.numel() != math.prod(sizes):
            raise UnsupportedNetwork(f"{values.numel()} numbers in {name} of the shape {quote(sizes)}")
        return values.reshape(sizes)

    def _bytes(self, content: dict[str, Any]) -> Any:
        if not content.get("place", 0):
            lists = content.get("floats", []) if content["data_type"] == 1 else content.get("doubles", [])
            return content["raw"] if "raw" in content else b"".join(lists)
        where = {entry["key"]: entry["value"] for entry in content["external"]}
        self.locations.add(where["location"])
        if len(self.locations) > 1:
            raise UnsupportedNetwork("weights in more than one other file")
        self.data = self.data or self.read_data()
        offset = checked_integer(int(where.get("offset", 0)), 0, len(self.data))
        size = checked_integer(int(where.get("length", len(self.data))), 0, len(self.data))
        part = memoryview(self.data)[offset : offset + size]
        self.used_bytes += len(part)
        if self.used_bytes > len(self.data):
            raise UnsupportedNetwork("weights that overlap")
        return part


def _from_bytes(stored: Any, dtype: torch.dtype) -> Tensor:
    """Convert little-endian numbers; copied, since torch's own memory is aligned for vector units."""
    if len(stored) % dtype.itemsize:
        raise UnsupportedNetwork("weights that end within a number")
    values = torch.empty(len(stored), dtype=torch.uint8)
    values.numpy()[:] = np.frombuffer(stored, np.uint8)
    return values != 0 if dtype == torch.bool else values.view(dtype)


class _GraphReader:
    """Turns one file's graph into steps; a name is defined once, as a numbered value or a small constant."""

    def __init__(self, graph: dict[str, Any], weights: _Weights):
        self.graph, self.nodes = graph, graph.get("node", [])
        self.weights: list[Tensor] = []
        self.count = 0  # numbered values so far
        self.of_four = set[int]()  # numbers of values known to have four dimensions
        self.values: dict[str, ValueRef | Tensor | None] = {"": None}  # an omitted input
        self.tensor = weights.tensor

    def read(self) -> tuple[Program, int | None]:
        """Return the program and its batch size, see `read_onnx`."""
        for initializer in self.graph.get("initializer", []):
            self._constant(initializer.get("name", ""), self.tensor(initializer))
        inputs = [place for place in self.graph["input"] if place["name"] not in self.values]
        for node in self.nodes:
            if node["op_type"] == "Constant":
                self._constant(node["output"][0], self._attribute(node["attribute"][0]))
        if len(inputs) != 1:
            raise UnsupportedNetwork(f"{len(inputs)} inputs, not one of N×3×S×S")
        batch, sizes = _shape(inputs[0]["type"]["tensor"])
        self.count = len(self.weights)
        self.of_four = {number for number, weight in enumerate(self.weights) if weight.dim() == 4}
        self._new(inputs[0]["name"])
        steps = [step for node in self.nodes for step in self._steps(node)]
        outputs = [self._known(place["name"]) for place in self.graph["output"]]
        if len(outputs) != 1 or not isinstance(outputs[0], ValueRef):
            raise UnsupportedNetwork(f"{len(outputs)} outputs, not one of N×K")
        mark_last_uses(steps, {*range(len(self.weights) + 1), outputs[0].number})
        return Program(self.weights, steps, outputs[0].number, sizes), batch

    def _constant(self, name: str, value: Any) -> None:
        """Number a weight, so that it moves with the network; keep short lists of sizes and factors on the CPU."""
        tensor = value if isinstance(value, Tensor) else torch.tensor(value)
        if tensor.numel() > (MAX_SCALARS if tensor.is_floating_point() else MAX_SIZES):
            self.weights.append(tensor)
            self._name(name, ValueRef(len(self.weights) - 1))
        else:
            self._name(name, tensor)

    def _name(self, name: str, value: ValueRef | Tensor | None) -> None:
        if name in self.values:
            raise UnsupportedNetwork(f"{quote(name)} twice, or no name")
        self.values[name] = value

    def _new(self, name: str) -> int:
        self._name(name, ValueRef(self.count))
        self.count += 1
        return self.count - 1

    def _known(self, name: str) -> ValueRef | Tensor | None:
        if name not in self.values:
            raise UnsupportedNetwork(f"{quote(name)} before it is computed")
        return self.values[name]

    def _steps(self, node: dict[str, Any]) -> list[Step]:
        """The steps that compute a node; none for a constant or an alias."""
        name, domain, outputs = node["op_type"], node.get("domain", ""), node["output"]
        if domain not in _STANDARD or name not in (*OPERATORS, "Constant", "Identity"):
            raise UnsupportedNetwork(f"the operator {quote(f'{domain}.{name}'.lstrip('.'))}")
        is_split = name == "Split"  # the operator of several results
        if len(outputs) != 1 and not is_split:
            raise UnsupportedNetwork(f"{len(outputs)} results of {name}, where only the first is supported")
        inputs = [self._known(word) for word in node.get("input", [])]
        if name == "Identity":
            self._name(outputs[0], *inputs)
        if name in ("Constant", "Identity"):
            return []
        operator, attributes = OPERATORS[name], self._attributes(node)
        if is_split and len(inputs) == 1:
            attributes.setdefault("num_outputs", len(outputs))
        operator.check(inputs, attributes)
        if calls := aten_calls(name, inputs, attributes, self.of_four):
            return self._aten_steps(calls, name, inputs[0], outputs[0])
        results = [self._new(word) for word in outputs]
        return [Step(operator, [InputDevice, *inputs], attributes, results, is_split, [])]

    def _aten_steps(self, calls: AtenCalls, name: str, value: Any, output: str) -> list[Step]:
        steps, is_four = [], name == "Conv" or value.number in self.of_four
        for compute, others in calls:
            steps.append(Step(compute, [value, *others], {}, [self.count], False, []))
            value, self.count = ValueRef(self.count), self.count + 1
        self._name(output, value)
        self.of_four |= {value.number} if is_four else set()
        return steps

    def _attributes(self, node: dict[str, Any]) -> dict[str, Any]:
        listed = [(attribute["name"], self._attribute(attribute)) for attribute in node.get("attribute", [])]
        if len(dict(listed)) != len(listed):
            raise UnsupportedNetwork("an attribute twice")
        return dict(listed)

    def _attribute(self, attribute: dict[str, Any]) -> Any:
        """A plain number, word or list of numbers, or a tensor."""
        contents = {kind: content for kind, content in attribute.items() if kind != "name"}
        if len(contents) != 1:
            raise UnsupportedNetwork(f"the attribute {quote(attribute.get('name'))} of {len(contents)} kinds")
        ((kind, content),) = contents.items()
        if kind == "t":
            return self.tensor(content)
        if isinstance(content, list) and len(content) > bounds.MAX_LIST:
            raise UnsupportedNetwork(f"a list of more than {bounds.MAX_LIST} items")
        return content


def _shape(tensor: dict[str, Any]) -> tuple[int | None, list[int | None]]:
    """The batch size and the input's sizes; None where any size is allowed."""
    if tensor["kind"] != 1:
        raise UnsupportedNetwork("an input that is not float32")
    sizes = [size.get("value") for size in tensor["shape"].get("dim", [])]
    if len(sizes) != 4:
        raise UnsupportedNetwork(f"an input of {len(sizes)} dimensions, not N×3×S×S")
    fixed = [None if size is None else checked_integer(size, 1, 1 << 16) for size in sizes]
    batch = None if fixed[0] is None else checked_integer(fixed[0], 1, bounds.MAX_BATCH)
    return batch, [None, *fixed[1:]]
