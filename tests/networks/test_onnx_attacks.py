"""ONNX files that were made to do harm: each ends in one sentence, and nothing of them is executed or followed.

Every file is an honest one with something changed. Python's audit events say which files were opened meanwhile, and
whether anything was written, started or connected; processor time and memory are limited.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import pickle
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from fuzz.watch import Watch, limits

from patchproof.base.errors import Refused
from patchproof.classifier import load_classifier

pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')

from onnx import ModelProto, TensorProto, helper
from onnx_files import SMALL, model, save, small

SHA1 = hashlib.sha1(next(t for t in small().graph.initializer if t.name == "W").raw_data).hexdigest()


class Opened(Watch):
    """Also which files are opened at all, Python's own apart."""

    def __init__(self):
        super().__init__()
        self.paths: set[str] = set()

    def harmful(self, event: str, arguments: tuple) -> bool:
        if event == "open" and not str(arguments[0]).endswith((".py", ".pyc", ".so", "/statm")):
            self.paths.add(str(arguments[0]))
        return super().harmful(event, arguments)


@pytest.fixture(scope="module")
def watch(tmp_path_factory) -> Opened:
    path = save(tmp_path_factory.mktemp("honest"), small())
    load_classifier(f"file:{path}", path.parent)  # what is imported late is imported
    importlib.import_module("torch._dynamo")  # so is what torch needs for some sizes: it makes a folder for its cache
    return Opened()


def refusal(made: ModelProto | bytes, watch: Opened, folder: Path) -> str:
    """The sentence; no other file than the three was opened."""
    path = save(folder, made)
    watch.paths.clear()
    with warnings.catch_warnings(), limits(), watch.on(folder), pytest.raises(Refused) as caught:
        warnings.simplefilter("ignore")  # doubts about a network that was changed
        load_classifier(f"file:{path}", folder)
    assert not watch.events
    assert watch.paths <= {str(path), str(path.with_suffix(".json")), str(folder / "x")}
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700
    return str(caught.value)


def changed(change: Callable[[ModelProto], object]) -> ModelProto:
    made = small()
    change(made)
    return made


def weight(made: ModelProto, name: str = "W") -> TensorProto:
    return next(tensor for tensor in made.graph.initializer if tensor.name == name)


def elsewhere(**entries: str) -> ModelProto:
    """A weight in another file."""
    made = small()
    weight(made).ClearField("raw_data")
    weight(made).data_location = TensorProto.EXTERNAL
    for key, value in entries.items():
        weight(made).external_data.add(key=key, value=value)
    return made


def two_elsewhere(first: str, second: str) -> ModelProto:
    made = elsewhere(location=first, length="432")
    weight(made, "F").ClearField("raw_data")
    weight(made, "F").data_location = TensorProto.EXTERNAL
    weight(made, "F").external_data.add(key="location", value=second)
    weight(made, "F").external_data.add(key="length", value="16")
    return made


def twice_elsewhere(made: ModelProto) -> None:
    made.CopyFrom(elsewhere(location="x"))
    weight(made).external_data.add(key="location", value="y")


def colors_last(made: ModelProto) -> None:
    dimensions = made.graph.input[0].type.tensor_type.shape.dim
    for dimension, word in zip(dimensions, ("BATCH", "FEATURE", "FEATURE", "CHANNEL"), strict=True):
        dimension.denotation = f"DATA_{word}"


def sized(*sizes: int) -> ModelProto:
    return changed(lambda made: (weight(made).ClearField("dims"), weight(made).dims.extend(sizes)))


def ending(nodes: str) -> ModelProto:
    """The small network with more behind it: z is its result before the mean."""
    return model(f"a = Conv<pads=[1,1,1,1]>(x, W, F) z = Relu(a) {nodes}")


def node(made: ModelProto, index: int = -1):
    return made.graph.node[index]


def batch(value: int) -> ModelProto:
    return changed(lambda made: setattr(made.graph.input[0].type.tensor_type.shape.dim[0], "dim_value", value))


def nested(depth: int) -> ModelProto:
    """Graphs within graphs."""
    graph = small().graph
    for _ in range(depth):
        inner = helper.make_node("If", ["c"], ["y"], then_branch=graph)
        graph = helper.make_graph([inner], "g", [], [])
    return changed(lambda made: made.graph.node.append(graph.node[0]))


def doubled(times: int) -> ModelProto:
    names = [f"d{number}" for number in range(times)]
    steps = [f"{name} = Concat<axis=3>({last}, {last})" for last, name in zip(["z", *names], names, strict=False)]
    return ending(f"{' '.join(steps)} y = Relu({names[-1]})")


def varint(number: int) -> bytes:
    return bytes([number & 127 | 128]) + varint(number >> 7) if number > 127 else bytes([number])


def wire(number: int, content: bytes) -> bytes:
    """One field that holds bytes."""
    return varint(number << 3 | 2) + varint(len(content)) + content


def longest(made: ModelProto, count: int) -> ModelProto:
    made.graph.node.extend([helper.make_node("Relu", ["x"], [f"r{number}"]) for number in range(count)])
    return made


SCALE = 's = Constant<value_floats=[1.0, 1.0, {0}, {0}]>() y = Resize<coordinate_transformation_mode="asymmetric", '
HOSTILE: dict[str, tuple[Callable[[], ModelProto | bytes], str]] = {
    # another file
    "a path upward": (lambda: elsewhere(location="../../../../../../etc/passwd"), "in a file beside the network"),
    "an absolute path": (lambda: elsewhere(location="/etc/passwd"), "got '/etc/passwd' named in .*: save it again"),
    "a path into a folder": (lambda: elsewhere(location="more/weights.bin"), "in a file beside the network"),
    "a path of Windows": (lambda: elsewhere(location="C:\\secret"), "in a file beside the network"),
    "the folder": (lambda: elsewhere(location="."), "in a file beside the network"),
    "a path with NUL": (lambda: elsewhere(location="a\0b"), "in a file beside the network|ValueError"),
    "a device": (lambda: elsewhere(location="/dev/zero", length="432"), "in a file beside the network"),
    "a name of no file": (lambda: elsewhere(location="w.bin"), r"no file at .*w\.bin: put w\.bin beside small\.onnx"),
    "no location": (lambda: elsewhere(offset="0"), r"\(KeyError\)"),
    "a pipe's name for an offset": (lambda: elsewhere(location="x", offset="|id"), r"no file at .*x"),
    # weights
    "two gigabytes claimed": (lambda: sized(1 << 29), r"108 numbers in 'W' of the shape \[536870912\]"),
    "sizes whose product wraps": (lambda: sized(1 << 31, 1 << 31, 1 << 31), "108 numbers in 'W'"),
    "a size past counting": (lambda: sized(1 << 40), "1099511627776 instead of a whole number from 0 to"),
    "a negative size": (lambda: sized(-4, 3, 3, 3), "-4 instead of a whole number from 0"),
    "a hundred dimensions": (lambda: sized(*[1] * 100), "'W' of a type that is not supported"),
    "text for a weight": (lambda: changed(lambda m: setattr(weight(m), "data_type", 8)), "of a type that is not"),
    "a type of no number": (lambda: changed(lambda m: setattr(weight(m), "data_type", 99)), "of a type that is not"),
    "bytes of another type": (lambda: changed(lambda m: setattr(weight(m), "data_type", 11)), "54 numbers in 'W'"),
    "half a number": (lambda: changed(lambda m: setattr(weight(m), "raw_data", b"123")), "end within a number"),
    "a pickle for a weight": (
        lambda: changed(lambda m: setattr(weight(m), "raw_data", pickle.dumps(sys.exit))),
        "numbers in 'W'|within a number",
    ),
    "strings for a weight": (lambda: changed(lambda m: weight(m).string_data.append(b"x")), "strings, which is not"),
    "the same weight twice": (lambda: changed(lambda m: m.graph.initializer.append(weight(m))), "'W' twice"),
    "an unknown entry of a place": (lambda: elsewhere(location="x", basepath="/etc"), "'basepath', 'location'"),
    "a place twice": (lambda: changed(twice_elsewhere), "some unknown or twice"),
    "sparse weights": (lambda: changed(lambda m: m.graph.sparse_initializer.add()), "sparse weights, which is not"),
    # the graph
    "a cycle": (lambda: changed(lambda m: node(m, 0).input.__setitem__(0, "y")), "'y' before it is computed"),
    "itself for an input": (lambda: changed(lambda m: node(m, 1).input.__setitem__(0, "b")), "'b' before it is"),
    "a value from nowhere": (lambda: changed(lambda m: node(m).input.__setitem__(0, "q")), "'q' before it is computed"),
    "one name for two values": (lambda: changed(lambda m: node(m).output.__setitem__(0, "b")), "'b' twice"),
    "an operator of Python's": (lambda: changed(lambda m: setattr(node(m), "op_type", "__import__")), "'__import__'"),
    "an operator of no list": (lambda: changed(lambda m: setattr(node(m), "op_type", "Unique")), "operator 'Unique'"),
    "random numbers": (lambda: ending("y = RandomNormalLike(z)"), "the operator 'RandomNormalLike'"),
    "another domain": (lambda: changed(lambda m: setattr(node(m), "domain", "com.evil")), "operator 'com.evil.Reduce"),
    "a branch": (lambda: nested(1), "a graph within the graph, which is not supported"),
    "thirty graphs in each other": (lambda: nested(30), "a graph within the graph, which is not supported"),
    "a function": (lambda: changed(lambda m: m.functions.add(name="Relu")), "functions of its own, which is not"),
    "a quantized tensor": (
        lambda: changed(lambda m: m.graph.quantization_annotation.add()),
        "quantized tensors, which",
    ),
    "colors last": (lambda: changed(colors_last), "DATA_FEATURE', 'DATA_CHANNEL'], not N×3×S×S"),
    "a field of the future": (lambda: small().SerializeToString() + wire(99, b"x"), "a field of the unknown number 99"),
    "an attribute of another type": (
        lambda: changed(lambda m: setattr(node(m).attribute[0], "type", 1)),
        "the attribute '.*' of 1 kinds",
    ),
    "a constant of two values": (
        lambda: changed(
            lambda m: m.graph.node.append(helper.make_node("Constant", [], ["q"], value_int=1, value_ints=[1]))
        ),
        "description cannot be read",
    ),
    "training": (lambda: changed(lambda m: m.training_info.add()), "training steps, which is not supported"),
    "no graph": (lambda: changed(lambda m: m.ClearField("graph")), r"\(KeyError\)"),
    "two inputs": (lambda: changed(lambda m: m.graph.input.add(name="x2")), "2 inputs, not one of N×3×S×S"),
    "two outputs": (lambda: changed(lambda m: m.graph.output.add(name="b")), "2 outputs, not one"),
    "a weight for a result": (lambda: changed(lambda m: setattr(m.graph.output[0], "name", "F")), "1 outputs, not"),
    "no opset": (lambda: changed(lambda m: m.ClearField("opset_import")), "opset none, not one from 7"),
    "an opset of long ago": (lambda: model(SMALL, 6), "opset 6, not one from 7 to 28"),
    "an opset of the future": (lambda: model(SMALL, 29), "opset 29, not one from 7 to 28"),
    "bytes for pictures": (
        lambda: changed(lambda m: setattr(m.graph.input[0].type.tensor_type, "elem_type", 2)),
        "an input that is not float32",
    ),
    "a batch of a billion": (lambda: batch(10**9), "1000000000 instead of a whole number from 1 to 65536"),
    "a batch of none": (lambda: batch(0), "0 instead of a whole number from 1"),
    "a negative batch": (lambda: batch(-1), "-1 instead of a whole number from 1"),
    "more operators than any network has": (lambda: longest(small(), 1 << 15), "more than 32768 items of node"),
    # attributes
    "an attribute of Python's": (
        lambda: changed(lambda m: node(m).attribute.append(helper.make_attribute("__class__", 1))),
        "unsupported inputs or attributes",
    ),
    "the device": (
        lambda: changed(lambda m: node(m).attribute.append(helper.make_attribute("device", "cuda:7"))),
        "an attribute 'device'",
    ),
    "an attribute twice": (
        lambda: changed(lambda m: node(m).attribute.append(node(m).attribute[0])),
        "an attribute twice",
    ),
    "an attribute of two kinds": (lambda: changed(lambda m: setattr(node(m).attribute[0], "f", 1)), "of 2 kinds"),
    "a reference": (
        lambda: changed(lambda m: setattr(node(m).attribute[0], "ref_attr_name", "axes")),
        "an attribute of an unusual kind, which is not supported",
    ),
    "text for sizes": (lambda: ending('y = MaxPool<kernel_shape="os.system">(z)'), "fails on 3×3×8×8"),
    "a long list": (lambda: ending(f"y = ReduceMean(z, {[1] * 2000})"), "more than 1024 items"),
    "a window past counting": (lambda: ending(f"y = MaxPool<kernel_shape=[{1 << 62}, 1]>(z)"), "fails on"),
    "no groups": (lambda: model("y = Conv<group=0>(x, W, F)"), "fails on"),
    "a step of nothing": (lambda: ending("y = Slice(z, [0], [4], [3], [0])"), r"fails on .*ValueError"),
    "a place past the end": (lambda: ending("y = Gather<axis=3>(z, [99])"), "fails on"),
    "training mode": (
        lambda: model("y = BatchNormalization<training_mode=1>(x, S, P, S, P)"),
        "the attribute training_mode = 1",
    ),
    # sizes that follow from others
    "sixty doublings": (lambda: doubled(60), "a tensor of an absurd size"),
    "a repetition past memory": (lambda: ending(f"y = Expand(z, [{1 << 24}, 1, 1, 1, 1, 1])"), "of an absurd size"),
    "tiles past memory": (lambda: ending(f"y = Tile(z, [1, 1, {1 << 20}, {1 << 20}])"), "of an absurd size"),
    "a constant past memory": (lambda: ending(f"c = ConstantOfShape([{1 << 45}]) y = Add(z, c)"), "of an absurd size"),
    "short lists that grow": (
        lambda: ending(f"p = Expand([7], [{1 << 40}]) q = Mul(p, p) y = Gather<axis=3>(z, q)"),
        "of an absurd size",
    ),
    "a split into a million": (
        lambda: ending(f"p = Expand(Zero, [{1 << 20}]) q, y = Split<axis=0, num_outputs={1 << 20}>(p)"),
        "it splits a tensor of an absurd size",
    ),
    "a range past memory": (
        lambda: ending(f"y = Range([0], [{1 << 50}], [1])"),
        "of an absurd size",
    ),
    "a border past memory": (lambda: ending(f"y = Pad(z, [0, 0, 0, 0, 0, 0, {1 << 20}, {1 << 20}])"), "absurd size"),
    "a border that is only on the way": (
        lambda: model(f"y = Conv<strides=[{1 << 20}, {1 << 20}], pads=[0, 0, {1 << 20}, {1 << 20}]>(x, W, F)"),
        "of an absurd size",
    ),
    "a product that is only on the way": (
        lambda: ending(f'p = Expand(Zero, [{1 << 20}]) y = Einsum<equation="bchw,d,e,d,e->b">(z, p, p, p, p)'),
        "of an absurd size",
    ),
    "a picture past memory": (lambda: ending(SCALE.format("99999.0") + 'nearest_mode="floor">(z, , s)'), "absurd size"),
    "sizes from what is seen": (
        lambda: ending("p = ReduceMax<keepdims=0>(z) q = Cast<to=7>(p) y = Reshape(z, q)"),
        "sizes in it depend on the pictures",
    ),
    "dimensions without end": (lambda: ending(f"y = Unsqueeze(z, {list(range(40))})"), "more than 12 dimensions"),
    # bytes
    "nothing": (lambda: b"", "opset none, not one from"),
    "a pickle": (lambda: pickle.dumps(sys.exit), "ONNX file"),
    "an archive": (lambda: b"PK\3\4" + bytes(200), "ONNX file"),
    "half a file": (lambda: small().SerializeToString()[:-40], "a field that ends after the file does"),
    "a number without end": (lambda: b"\x38" + b"\xff" * 100, "a number of more than 64 bits"),
    "groups in each other": (lambda: b"\x3b" * 100_000, "a field of wire type 3"),
    "empty nodes, megabytes": (lambda: wire(7, b"\x0a\x00" * 1_200_000), "more than 32768 items of node"),
    "fields of nothing, megabytes": (lambda: b"\x08\x00" * 1_200_000, "more than 524288 fields"),
    "sizes, megabytes": (lambda: wire(7, wire(5, wire(1, bytes(1_200_000)))), "more than 524288 fields"),
    "fractions, four megabytes": (
        lambda: wire(7, wire(1, wire(5, wire(7, bytes(4_000_000))))),
        "more than 32768 floats",
    ),
    "a name of a megabyte": (lambda: wire(7, wire(1, wire(4, b"x" * 1_000_000))), "op_type of more than 65536 bytes"),
    "a name that is no text": (lambda: wire(7, wire(1, wire(4, b"\xff\xfe"))), r"\(UnicodeDecodeError\)"),
    "two graphs": (lambda: small().SerializeToString() + wire(7, b""), "graph twice"),
    "a number for a graph": (lambda: b"\x38\x01", "graph of an unexpected wire type"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused_in_one_sentence(name, watch, tmp_path):
    make, sentence = HOSTILE[name]
    said = refusal(make(), watch, tmp_path)
    assert re.search(sentence, said), said


@pytest.mark.parametrize(
    ("entries", "sentence"),
    [
        ({"location": "x"}, None),
        ({"location": "x", "length": "432", "offset": "0", "checksum": SHA1.upper()}, None),
        ({"location": "x", "checksum": SHA1.replace("a", "b")}, "in 'x' whose SHA-1 is not the stated checksum"),
        ({"location": "x", "offset": "-1"}, "-1 instead of a whole number from 0 to"),
        ({"location": "x", "offset": "433"}, "433 bytes of weights in .x., got 432 bytes: copy or download both"),
        ({"location": "x", "length": str(1 << 40)}, "1099511627776 bytes of weights in .x., got 432"),
        ({"location": "x", "offset": "4"}, "107 numbers in 'W'"),
        ({"location": "x", "length": "9" * 5000}, r"\(ValueError\)"),
    ],
)
def test_weights_in_the_other_file_stay_within_it(entries, sentence, watch, tmp_path):
    (tmp_path / "x").write_bytes(weight(small()).raw_data)
    (tmp_path / "small.onnx.data").write_bytes(bytes(432))  # of an earlier export, which the file does not name
    if sentence is not None:
        assert re.search(sentence, refusal(elsewhere(**entries), watch, tmp_path))
        return
    path = save(tmp_path, elsewhere(**entries))
    watch.paths.clear()
    with watch.on(tmp_path):
        loaded = load_classifier(f"file:{path}", tmp_path)
    assert watch.paths == {str(path), str(path.with_suffix(".json")), str(tmp_path / "x")} and not watch.events
    whole = load_classifier(f"file:{save(tmp_path, small(), name='whole')}", tmp_path)
    photos = torch.rand(1, 3, 8, 8)
    torch.testing.assert_close(loaded.logits(photos), whole.logits(photos))


def test_weights_may_lie_in_several_files_and_share_no_bytes(watch, tmp_path):
    (tmp_path / "x").write_bytes(weight(small()).raw_data + bytes(8))
    (tmp_path / "y").write_bytes(weight(small(), "F").raw_data)
    assert "weights that overlap" in refusal(two_elsewhere("x", "x"), watch, tmp_path)
    photos = torch.rand(1, 3, 8, 8)
    networks = [save(tmp_path, two_elsewhere("x", "y"), name="two"), save(tmp_path, small(), name="whole")]
    torch.testing.assert_close(*(load_classifier(f"file:{path}", tmp_path).logits(photos) for path in networks))


def test_what_is_no_file_of_the_folder_is_not_read_as_weights(watch, tmp_path, tmp_path_factory):
    (tmp_path / "x").mkdir()
    assert "no file at" in refusal(elsewhere(location="x"), watch, tmp_path)
    outside = tmp_path_factory.mktemp("outside") / "x"
    outside.write_bytes(weight(small()).raw_data)
    (tmp_path / "y").symlink_to(outside)
    assert "weights in a file beside the network" in refusal(elsewhere(location="y"), watch, tmp_path)
    os.mkfifo(tmp_path / "z")
    assert "no file at" in refusal(elsewhere(location="z"), watch, tmp_path)
