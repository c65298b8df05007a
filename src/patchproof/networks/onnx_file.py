"""`file:NAME.onnx`: read an untrusted ONNX file without the library onnx.

In: its bytes, and a function that reads the files of large weights by a weight's "location". Out: a Program of numbered
steps (graph.py), how many pictures it takes, and the file's metadata. Anything unsupported, every unknown field and
attribute included, raises UnsupportedNetwork. Nothing of the file is executed. Left out on purpose: subgraphs (If,
Loop), functions of the file, operators of other domains, sparse and quantized weights, opsets before 7, which
onnx.version_converter converts to newer ones.

Source: github.com/onnx/onnx, onnx.proto (IR version 13).
"""

import functools
import hashlib
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from patchproof.base.errors import Refused
from patchproof.networks import bounds
from patchproof.networks.bounds import UnsupportedNetwork, checked_integer, quote
from patchproof.networks.graph import InputDevice, Program, Step, ValueRef, mark_last_uses
from patchproof.networks.onnx_operators import DTYPES, RESULTS, find_operator
from patchproof.networks.onnx_shapes import MAX_SIZES
from patchproof.networks.protobuf import MessageReader, read_schemas

_ATEN = torch.ops.aten
AtenCalls = list[tuple[Callable[..., Any], list[Any]]]  # operators, each with its arguments after the first
OPSETS = (7, 28)
_EXTERNAL = {"location", "offset", "length", "checksum"}  # what says where a weight lies in another file
_STANDARD = ("", "ai.onnx")  # the domain
MAX_SCALARS = 8  # floats that stay on the CPU; a Resize has up to eight factors

_SCHEMAS = read_schemas("""
entry: 1 key text; 2 value text.
tensor: 1 dims int*; 2 data_type int; 3 segment never; 4 floats bytes*; 5 ints int*; 6 strings never; 7 longs int*;
  8 name text; 9 raw bytes; 10 doubles bytes*; 11 unsigned never; 13 external entry*; 14 place int; 12,16 skipped.
attribute: 1 name text; 2 f float; 3 i int; 4 s text; 5 t tensor; 6 a graph within the graph never; 7 floats float*;
  8 ints int*; 9 strings text*; 20 type int; 13 skipped; 10,11,14,15,21,22,23 an attribute of an unusual kind never.
node: 1 input text*; 2 output text*; 4 op_type text; 5 attribute attribute*; 7 domain text; 8 overload never;
  3,6,9 skipped.
size: 1 value int; 2 symbol text; 3 denotation text.
shape: 1 dim size*.
array: 1 kind int; 2 shape shape.
type: 1 tensor array; 4,5,8,9 an input that is no tensor never; 6 skipped.
input: 1 name text; 2 type type; 3,4 skipped.
output: 1 name text; 2,3,4 skipped.
graph: 1 node node*; 5 initializer tensor*; 11 input input*; 12 output output*; 14 quantized tensors never;
  15 sparse weights never; 2,10,13,16 skipped.
opset: 1 domain text; 2 version int.
model: 7 graph graph; 8 opset opset*; 14 metadata entry*; 20 training steps never; 25 functions of its own never;
  1,2,3,4,5,6 skipped.
""")
# an attribute's type, as the file states it: where its value is, and the value where none is written
_ATTRIBUTE_TYPES = {1: ("f", 0.0), 2: ("i", 0), 3: ("s", ""), 4: ("t", None)}
_ATTRIBUTE_TYPES |= {6: ("floats", []), 7: ("ints", []), 8: ("strings", [])}
_DENOTATIONS = ("DATA_BATCH", "DATA_CHANNEL", "DATA_FEATURE", "DATA_FEATURE")  # of a picture's dimensions


def read_onnx(
    stored: bytes, read_data: Callable[[str], bytes], join: Callable[..., Tensor] | None = None
) -> tuple[Program, int | None, dict[str, str]]:
    """The network, the number of pictures it takes (None: any), and its metadata. `read_data` reads the file of weights
    that a location names, each at most once. With `join`, called with the outputs' names and values, the network gives
    its result, and may have several outputs.
    """
    model = MessageReader().message(memoryview(stored), _SCHEMAS["model"])
    versions = [opset.get("version", 0) for opset in model.get("opset", []) if opset.get("domain", "") in _STANDARD]
    if len(versions) != 1 or not OPSETS[0] <= versions[0] <= OPSETS[1]:
        raise UnsupportedNetwork(f"opset {quote(versions)[1:-1] or 'none'}, not one from {OPSETS[0]} to {OPSETS[1]}")
    metadata = {entry.get("key", ""): entry.get("value", "") for entry in model.get("metadata", [])}
    return *_GraphReader(model["graph"], _Weights(read_data), versions[0]).read(join), metadata


class _Weights:
    """Reads tensors from their descriptions; each byte of another file belongs to one tensor at most."""

    def __init__(self, read_data: Callable[[str], bytes]):
        self.read_data, self.used_bytes = functools.cache(read_data), Counter[str]()
        self.sha1 = functools.cache(lambda name: hashlib.sha1(self.read_data(name), usedforsecurity=False).hexdigest())

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
        if len(where) < len(content["external"]) or not where.keys() <= _EXTERNAL:
            raise UnsupportedNetwork(f"entries {quote(sorted(where))} of external weights, some unknown or twice")
        data = self.read_data(location := where["location"])
        if "checksum" in where and where["checksum"].lower() != self.sha1(location):
            raise UnsupportedNetwork(f"weights in {quote(location)} whose SHA-1 is not the stated checksum")
        offset = checked_integer(int(where.get("offset", 0)), 0, 1 << 62)
        size = checked_integer(int(where.get("length", max(len(data) - offset, 0))), 0, 1 << 62)
        if offset + size > len(data):
            do = "copy or download both files again: it was cut short, or is another network's"
            raise Refused(f"{offset + size} bytes of weights in {quote(location)}", f"{len(data)} bytes", do)
        part = memoryview(data)[offset : offset + size]
        self.used_bytes[location] += len(part)
        if self.used_bytes[location] > len(data):
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

    def __init__(self, graph: dict[str, Any], weights: _Weights, opset: int):
        self.graph, self.nodes, self.opset = graph, graph.get("node", []), opset
        self.uses = Counter(name for node in self.nodes for name in node.get("input", []))
        self.uses.update(output["name"] for output in graph["output"])
        self.weights: list[Tensor] = []
        self.count = 0  # numbered values so far
        # values known to have four dimensions; of weights the last two
        self.of_four: dict[int | None, list[int] | None] = {}
        self.values: dict[str, ValueRef | Tensor | None] = {"": None}  # an omitted input
        self.tensor = weights.tensor

    def read(self, join: Callable[..., Tensor] | None = None) -> tuple[Program, int | None]:
        """Return the program and its batch size, see `read_onnx`."""
        for initializer in self.graph.get("initializer", []):
            self._constant(initializer.get("name", ""), self.tensor(initializer))
        inputs = [place for place in self.graph["input"] if place["name"] not in self.values]
        for node in self.nodes:
            if node["op_type"] == "Constant":
                ((kind, value),) = self._attributes(node).items()
                dtype = torch.int64 if kind in ("value_int", "value_ints") else torch.float32
                tensor = value if isinstance(value, Tensor) else torch.tensor(value, dtype=dtype)
                self._constant(node["output"][0], tensor)
        if len(inputs) != 1:
            raise UnsupportedNetwork(f"{len(inputs)} inputs, not one of N×3×S×S")
        batch, sizes, colors_last = _shape(inputs[0]["type"]["tensor"])
        self.count, self.constants = len(self.weights), {*self.values}  # before aliases of them
        self.of_four |= {i: list(weight.shape[2:]) for i, weight in enumerate(self.weights) if weight.dim() == 4}
        photos = self._new(f"{inputs[0]['name']} N×3×S×S" if colors_last else inputs[0]["name"])
        steps: list[Step] = []
        if colors_last:  # as TensorFlow's are
            results = [self._new(inputs[0]["name"])]
            steps.append(Step(torch.permute, [ValueRef(photos), (0, 2, 3, 1)], {}, results, False))
        self.of_photos = {photos, self.count - 1}  # computed from pictures
        for node in self.nodes:
            steps.extend(self._steps(node))
        names = [place["name"] for place in self.graph["output"]]
        outputs = [self._known(name) for name in names]
        if join is not None and outputs:
            steps.append(Step(functools.partial(join, names), outputs, {}, [self.count], False))
            outputs = [ValueRef(self.count)]
        if len(outputs) != 1 or not isinstance(outputs[0], ValueRef):
            raise UnsupportedNetwork(f'{len(outputs)} outputs, not one (of a detector: write "kind": "detector")')
        mark_last_uses(steps, {*range(len(self.weights) + 1), outputs[0].number})
        return Program(self.weights, steps, outputs[0].number, sizes), batch

    def _constant(self, name: str, tensor: Tensor) -> None:
        """Number a weight, so that it moves with the network; keep short lists of sizes and factors on the CPU."""
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
        if name:
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
        if domain not in _STANDARD:
            raise UnsupportedNetwork(f"the operator {quote(f'{domain}.{name}')}")
        if name == "Identity" and node.get("attribute"):
            raise UnsupportedNetwork("an attribute of Identity")
        inputs = [self._known(word) for word in node.get("input", [])]
        if name == "Identity":
            self._name(outputs[0], *inputs)
        if name in ("Constant", "Identity"):
            return []
        operator, attributes = find_operator(name, self.opset), self._attributes(node)
        count = len(outputs) if name == "Split" else RESULTS.get(name, 1)
        if self.uses.keys() & {*outputs[count:]} - {""}:
            raise UnsupportedNetwork(f"{len(outputs)} results of {name}, where only {count} can be used")
        outputs = outputs[:count]
        if name == "Split" and len(inputs) == 1:
            attributes.setdefault("num_outputs", len(outputs))
        operator.check(inputs, attributes)
        of_photos = any(isinstance(value, ValueRef) and value.number in self.of_photos for value in inputs)
        if of_photos and name == "BatchNormalization" and attributes.get("training_mode"):
            raise UnsupportedNetwork("the attribute training_mode = 1")
        is_own = name == "Conv" and (word := node["input"][1]) in self.constants and self.uses[word] == 1
        if calls := _aten_calls(name, inputs, attributes, self.of_four, self.weights if is_own else []):
            steps = self._aten_steps(calls, name, inputs[0], outputs[0])
        else:
            results = [self._new(word) for word in [*outputs, *[""] * (count - len(outputs))]]
            steps = [Step(operator, [InputDevice, *inputs], attributes, results, name == "Split" or count > 1)]
        self.of_photos.update(number for step in steps for number in step.results if of_photos)
        return steps

    def _aten_steps(self, calls: AtenCalls, name: str, value: Any, output: str) -> list[Step]:
        steps, is_four = [], name == "Conv" or value.number in self.of_four
        for compute, others in calls:
            steps.append(Step(compute, [value, *others], {}, [self.count], False))
            value, self.count = ValueRef(self.count), self.count + 1
        self._name(output, value)
        self.of_four |= {value.number: None} if is_four else {}
        return steps

    def _attributes(self, node: dict[str, Any]) -> dict[str, Any]:
        listed = [(attribute["name"], self._attribute(attribute)) for attribute in node.get("attribute", [])]
        if len(dict(listed)) != len(listed):
            raise UnsupportedNetwork("an attribute twice")
        return dict(listed)

    def _attribute(self, attribute: dict[str, Any]) -> Any:
        """A plain number, word or list of numbers, or a tensor."""
        contents = {kind: content for kind, content in attribute.items() if kind not in ("name", "type")}
        stated, default = _ATTRIBUTE_TYPES.get(attribute.get("type", 0), (None, None))
        if default is not None:  # writers may leave out zeros and empty lists
            contents = contents or {stated: default}
        if len(contents) != 1 or (stated and stated not in contents):
            raise UnsupportedNetwork(f"the attribute {quote(attribute.get('name'))} of {len(contents)} kinds")
        ((kind, content),) = contents.items()
        if kind == "t":
            return self.tensor(content)
        if isinstance(content, list) and len(content) > bounds.MAX_LIST:
            raise UnsupportedNetwork(f"a list of more than {bounds.MAX_LIST} items")
        return content


def _shape(tensor: dict[str, Any]) -> tuple[int | None, list[int | None], bool]:
    """The batch size and the sizes of pictures N×3×S×S, None where any is allowed; True if they come as N×S×S×3."""
    if tensor["kind"] != 1:
        raise UnsupportedNetwork("an input that is not float32")
    dimensions = tensor["shape"].get("dim", [])
    sizes = [size.get("value") for size in dimensions]
    if len(sizes) != 4:
        raise UnsupportedNetwork(f"an input of {len(sizes)} dimensions, not N×3×S×S")
    if colors_last := sizes[3] == 3 and sizes[1] != 3:
        dimensions, sizes = ([values[i] for i in (0, 3, 1, 2)] for values in (dimensions, sizes))
    stated = [size.get("denotation") or right for size, right in zip(dimensions, _DENOTATIONS, strict=True)]
    if stated != list(_DENOTATIONS):
        raise UnsupportedNetwork(f"an input of the dimensions {quote(stated)}, not N×3×S×S")
    fixed = [None if size is None else checked_integer(size, 1, 1 << 16) for size in sizes]
    batch = None if fixed[0] is None else checked_integer(fixed[0], 1, bounds.MAX_BATCH)
    return batch, [None, *fixed[1:]], colors_last


def _aten_calls(
    name: str, inputs: Sequence[Any], attributes: dict[str, Any], of_four: Mapping[int | None, Any], own: list[Tensor]
) -> AtenCalls:
    """The ATen operators that a node's first input passes through one after the other, so that activations behind them
    can be computed in place; none where onnx_operators.py has to compute the node. Without them MobileNetV2's answers
    took 1.46 times as long, its gradients 1.85 times (torch 2.13, one core). `of_four` holds the numbers of weights and
    pictures N×C×H×W, with H×W of weights; `own` has the weights if this node alone uses its.
    """
    numbers = [item.number if type(item) is ValueRef else None for item in inputs]
    weight = numbers[1] if name == "Conv" else None
    if weight in of_four and not isinstance(inputs[-1], Tensor):
        if attributes.get("kernel_shape", of_four[weight]) != of_four[weight]:
            return []
        return _conv(own, *inputs[1:], **attributes)
    if name == "Clip" and numbers[0] is not None:
        return _clip(*inputs[1:], **attributes)
    if name == "Relu" and numbers[0] is not None:
        return [(_ATEN.relu.default, [])]
    if name == "Add" and all(number in of_four for number in numbers):
        return [(_ATEN.add.Tensor, [inputs[1]])]
    return []


def _conv(
    own, w, b=None, *, auto_pad="NOTSET", dilations=None, group=1, pads=None, strides=None, **_: Any
) -> AtenCalls:
    if auto_pad != "NOTSET" or (pads is not None and len(pads) != 4):
        return []
    top, left, bottom, right = pads or [0] * 4
    missing = [max(0, right - left), max(0, left - right), max(0, bottom - top), max(0, top - bottom)]
    calls: AtenCalls = []
    if any(missing):  # as TensorFlow pads
        one_color = len(own) > w.number and own[w.number].shape[1] == 1
        if one_color and min(top, left, bottom, right) >= 0 and max(missing) == 1 and dilations in (None, [1, 1]):
            # a row or column of zeros more in the weights: MobileNetV2's answers and gradients take 0.95 of the time;
            # with more colors, computing the added zeros takes longer
            own[w.number], top, left = F.pad(own[w.number], missing), max(top, bottom), max(left, right)
        else:
            calls, top, left = [(_ATEN.constant_pad_nd.default, [[left, right, top, bottom]])], 0, 0
    others = [dilations or [1, 1], False, [0, 0], group]
    return [*calls, (_ATEN.convolution.default, [w, b, strides or [1, 1], [top, left], *others])]


def _clip(min: Any = None, max: Any = None) -> AtenCalls:
    """A hardtanh if both limits are known; unlike torch.clamp, its gradient is 0 at the limits, as ReLU6's is."""
    ends = [torch.tensor(end) if isinstance(end, float) else end for end in (min, max)]
    limits = [float(end) for end in ends if isinstance(end, Tensor) and end.is_floating_point() and not end.dim()]
    return [(_ATEN.hardtanh.default, limits)] if len(limits) == 2 and limits[0] <= limits[1] else []
