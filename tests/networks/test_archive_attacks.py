"""Archives that were made to do harm: each ends in one sentence or loads harmlessly, and nothing of them is executed.

Every archive is an honest one with something changed. Text that would make a folder if it were Python stands, in turn,
in every place of the JSON that holds text; Python's audit events say whether anything was compiled, executed, imported,
unpickled, opened to be written, connected or started meanwhile.
"""

import copy
import json
import re
import stat
import struct
import sys
import warnings
import zipfile
from pathlib import Path

import pytest
import torch
from archives import Hostile, exported, save
from torch import Tensor, nn
from torch.nn import functional as F

from patchproof.base.strict import Refused
from patchproof.classifier import load_classifier
from patchproof.networks import description
from patchproof.networks.operators import operator_named

PROGRAM = "models/model.json"
WEIGHTS, CONSTANTS = "data/weights/model_weights_config.json", "data/constants/model_constants_config.json"
EVIL = "evil_of_the_archive"  # in every text that comes from a hostile file
ALWAYS = re.compile(
    r"os\.(system|exec|posix_spawn|spawn|startfile|mkdir|rename|remove|chmod)|subprocess|socket\.|pickle"
)


class Watch:
    """Audit events of what an archive must not do; a hook stays for good, so it has a switch."""

    def __init__(self):
        self.on, self.events = False, []
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple) -> None:
        if self.on and self.harmful(event, arguments):
            self.events.append((event, str(arguments)[:200]))

    def harmful(self, event: str, arguments: tuple) -> bool:
        if event == "open":
            path, mode, _ = arguments
            return bool(re.search("[wax+]", mode or "")) and "__pycache__" not in str(path)
        if event == "exec":
            return EVIL in repr((arguments[0].co_consts, arguments[0].co_names, arguments[0].co_filename))
        return bool(ALWAYS.match(event)) or (event in ("compile", "import") and EVIL in repr(arguments))

    def __enter__(self):
        self.on, self.events = True, []

    def __exit__(self, *error):
        self.on = False


@pytest.fixture(scope="module")
def watch() -> Watch:
    return Watch()


def test_the_watch_sees_what_it_is_for(watch, tmp_path):
    deeds = [
        lambda: eval(f"'{EVIL}'"),
        lambda: exec(f"{EVIL} = 1", {}),
        lambda: (tmp_path / "f").write_text("x"),
        lambda: (tmp_path / "d").mkdir(),
        lambda: __import__("os").system("true"),
        lambda: __import__("subprocess").run(["true"], check=True),
        lambda: __import__("pickle").loads(b"cbuiltins\nlen\n."),
        lambda: __import__("socket").socket().close(),
    ]
    for deed in deeds:
        with watch:
            deed()
        assert watch.events, deed
    with pytest.raises(ImportError), watch:
        __import__(EVIL)
    assert watch.events


class Mixed(nn.Module):
    """Arguments of many kinds: sizes that are computed, lists, text, types, infinities, results in a sequence."""

    def __init__(self):
        super().__init__()
        self.conv = nn.Conv2d(3, 4, 3, padding="same")
        self.norm = nn.BatchNorm2d(4)
        self.tied = nn.Linear(4, 4, bias=False)
        self.register_buffer("mean", torch.full((1, 3, 1, 1), 0.5), persistent=False)
        self.register_buffer("mask", torch.eye(4).bool())

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.norm(self.conv(x - self.mean)), inplace=True)
        left, right = y.split([1, 3], 1)
        y = F.gelu(torch.cat([left, right], 1), approximate="tanh").to(torch.float64).float()
        y = y.view(x.shape[0] * 4, 256).mean(1, keepdim=True).reshape(x.shape[0], 4)
        return self.tied(y) + 0.1 * torch.zeros(4, device=x.device).masked_fill(self.mask, -1.0)[0] + y


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    path = save(tmp_path_factory.mktemp("honest"), exported(Mixed()))
    if not any(name.endswith("weights_config.json") for name in zipfile.ZipFile(path).namelist()):
        pytest.skip(f"torch {torch.__version__} saves weights as pickles, which are refused; 2.9 does not")
    return path


@pytest.fixture
def hostile(tmp_path, honest) -> Hostile:
    return Hostile(tmp_path / EVIL, honest)


@pytest.fixture(scope="module")
def truth(honest) -> Tensor:
    return load_classifier(f"file:{honest}", honest.parent).network(photos())


def photos() -> Tensor:
    return torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(5))


def answer(hostile: Hostile, watch: Watch) -> Tensor | str:
    """The logits, or the sentence of the refusal; nothing may have happened besides."""
    path = hostile.write()
    with watch, warnings.catch_warnings():
        try:
            warnings.simplefilter("ignore")  # doubts about a network that was changed
            result = load_classifier(f"file:{path}", path.parent).network(photos())
        except Refused as error:
            result = str(error)
    assert not watch.events
    assert not hostile.executed() and sorted(file.suffix for file in path.parent.iterdir()) == [".json", ".pt2"]
    assert isinstance(result, Tensor) or ("\n" not in result and len(result) < 900)
    return result


def places(value, kind: type, path: tuple = ()):
    """Where a value of that type stands in parsed JSON, one place for each kind of place: lists count once."""
    if type(value) is kind:
        yield path
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield from places(item, kind, (*path, key))


def kinds_of_places(value, kind: type) -> list[tuple]:
    own = {"config", "tensor_values", "range_constraints", "sym_int_values"}  # tables by names of the file
    first: dict[tuple, tuple] = {}
    for path in places(value, kind):
        general = tuple("*" if type(key) is int or (i and path[i - 1] in own) else key for i, key in enumerate(path))
        first.setdefault(general, path)
    return list(first.values())


def put(value, path: tuple, new) -> None:
    for key in path[:-1]:
        value = value[key]
    value[path[-1]] = new


@pytest.mark.parametrize("member", [PROGRAM, WEIGHTS, CONSTANTS])
def test_text_with_code_in_every_place_is_never_executed(member, hostile, watch, truth):
    original = json.loads(hostile.members[f"{hostile.root}/{member}"])
    texts = [hostile.python(), f"x=({hostile.python()})", f"{EVIL}.system", "os.system"]
    strings = kinds_of_places(original, str)
    assert len(strings) >= (30 if member == PROGRAM else 2)
    loaded = 0
    for number, path in enumerate(strings):
        content = copy.deepcopy(original)
        put(content, path, texts[number % len(texts)])
        hostile.set(member, content)
        result = answer(hostile, watch)
        loaded += isinstance(result, Tensor)
        if isinstance(result, Tensor):  # it stood in a place that is not read
            torch.testing.assert_close(result, truth)
    assert (loaded > 10) == (member == PROGRAM)


@pytest.mark.parametrize("member", [PROGRAM, WEIGHTS, CONSTANTS])
def test_names_with_code_in_every_table_are_never_executed(member, hostile, watch, truth):
    original = json.loads(hostile.members[f"{hostile.root}/{member}"])
    for path in kinds_of_places(original, dict):
        content = copy.deepcopy(original)
        table = content
        for key in path:
            table = table[key]
        if table:
            table[f"x=({hostile.python()})"] = table.pop(next(iter(table)))
            result = answer(hostile.set(member, content), watch)
            assert isinstance(result, str) or torch.equal(result, truth)


STRANGE = [-1, 1 << 31, 1 << 63, 10**40, True, None, "1", [], {}, 0.5, [[1]], {"as_int": -(1 << 63)}]


@pytest.mark.parametrize("member", [PROGRAM, WEIGHTS, CONSTANTS])
def test_strange_numbers_in_every_place_are_refused_or_harmless(member, hostile, watch):
    original = json.loads(hostile.members[f"{hostile.root}/{member}"])
    for number, path in enumerate(kinds_of_places(original, int)):
        for strange in STRANGE[number % 4 :: 4]:
            content = copy.deepcopy(original)
            put(content, path, strange)
            answer(hostile.set(member, content), watch)


def nodes(content: dict) -> list[dict]:
    return content["graph_module"]["graph"]["nodes"]


def node(content: dict, target: str) -> dict:
    return next(node for node in nodes(content) if target in node["target"])


TARGETS = """os.system torch.load torch.hub.load torch.ops.load_library torch.ops.higher_order.cond builtins.eval eval
torch.ops.higher_order.wrap_with_set_grad_enabled _operator.attrgetter _operator.methodcaller _operator.getitem
_operator.pow _operator.lshift _operator.call math.__loader__ math.factorial torch.sym_sqrt torch.ops.aten.save.default
torch.ops.aten.from_file.default torch.ops.aten.relu torch.ops.aten.relu.__class__ torch.ops.aten.__class__.mro
torch.ops.aten.rand.default torch.ops.aten.bernoulli.p torch.ops.aten.item.default torch.ops.aten.set_.source_Tensor
torch.ops.aten.resize_.default torch.ops.aten._weight_norm.default torch.ops.prims.add.default torch.ops.profiler.x.y
torch.ops.aten.relu.out torch.ops.aten.relu.default.__call__ torch.ops.torchvision.nms.default #x""".split()


@pytest.mark.parametrize("target", [*TARGETS, "", "torch.ops.aten.relu.default\n", f"torch.ops.{EVIL}.x.default"])
def test_operators_that_are_not_on_the_list_are_refused_by_name(target, hostile, watch):
    result = answer(hostile.edit(PROGRAM, lambda c: nodes(c)[-1].update(target=target)), watch)
    assert f"the operator {target!r}" in result


def argument(content: dict, target: str, index: int) -> dict:
    return node(content, target)["inputs"][index]["arg"]


def meta(content: dict, name: str = "conv.weight") -> dict:
    return content["config"][name]["tensor_meta"]


def weights_that(**values):
    return WEIGHTS, lambda c: meta(c).update(values)


def sizes(*numbers):
    return [{"as_int": number} for number in numbers]


def spec(content: dict) -> list[dict]:
    return content["graph_module"]["signature"]["input_specs"]


def twice(content: dict) -> None:
    nodes(content)[1]["outputs"] = nodes(content)[0]["outputs"]


def cycle(content: dict) -> None:
    nodes(content)[0]["inputs"][0]["arg"] = copy.deepcopy(nodes(content)[-1]["outputs"][0])


def grown(content: dict) -> None:
    """Sixty doublings of a tensor."""
    last = content["graph_module"]["graph"]["outputs"][0]["as_tensor"]["name"]
    for step in range(60):
        pair = [{"name": last}] * 2
        last = f"grown{step}"
        inputs = [{"name": "tensors", "arg": {"as_tensors": pair}, "kind": 1}]
        outputs = [{"as_tensor": {"name": last}}]
        nodes(content).append({"target": "torch.ops.aten.cat.default", "inputs": inputs, "outputs": outputs})


def squared(content: dict) -> None:
    """The size of the batch, squared again and again."""
    last = node(content, "sym_size")["outputs"][0]["as_sym_int"]["as_name"]
    for step in range(80):
        inputs = [{"name": name, "arg": {"as_sym_int": {"as_name": last}}, "kind": 1} for name in "ab"]
        last = f"squared{step}"
        outputs = [{"as_sym_int": {"as_name": last}}]
        nodes(content).append({"target": "_operator.mul", "inputs": inputs, "outputs": outputs})


def weight_changed(content: dict) -> None:
    weight = {"as_tensor": {"name": "p_conv_bias"}}
    new = {"name": "other", "arg": {"as_int": 1}, "kind": 1}
    inputs = [{"name": "self", "arg": weight, "kind": 1}, new]
    outputs = [{"as_tensor": {"name": "changed"}}]
    nodes(content).append({"target": "torch.ops.aten.add_.Scalar", "inputs": inputs, "outputs": outputs})


def nested(depth: int):
    text = "[" * depth + "]" * depth
    return lambda content: content["graph_module"].update(metadata=json.loads(text) if depth < 900 else text)


def first_size(value):
    def change(content):
        content["graph_module"]["graph"]["tensor_values"]["x"]["sizes"][0] = value

    return change


def constrained(low, high):
    return lambda c: [limits.update(min_val=low, max_val=high) for limits in c["range_constraints"].values()]


CHANGES = {
    "sizes of 2^31 squared": (*weights_that(sizes=sizes(1 << 31, 1 << 31)), "absurd size"),
    "sizes whose product wraps": (*weights_that(sizes=sizes(1 << 32, 1 << 32)), "absurd size"),
    "no numbers, absurd size": (*weights_that(sizes=sizes(0, 1 << 61), strides=sizes(1, 1)), "absurd size"),
    "a negative size": (*weights_that(sizes=sizes(-1, 3, 3, 3)), "-1 for a whole number"),
    "a negative stride": (*weights_that(strides=sizes(27, 9, -3, 1)), "-3 for a whole number"),
    "a huge stride": (*weights_that(strides=sizes(1 << 61, 9, 3, 1)), "with a stride of 2305843009213693952"),
    "a stride past the end": (*weights_that(strides=sizes(28, 9, 3, 1)), "'conv.weight' outside of its bytes"),
    "an offset past the end": (*weights_that(storage_offset={"as_int": 1}), "'conv.weight' outside of its bytes"),
    "a negative offset": (*weights_that(storage_offset={"as_int": -1}), "-1 for a whole number"),
    "another type, wider": (*weights_that(dtype=8), "'conv.weight' outside of its bytes"),
    "no type at all": (*weights_that(dtype=0), "of a type that is not supported"),
    "a type that is text": (*weights_that(dtype="7"), "'7' for a whole number"),
    "a sparse layout": (*weights_that(layout=1), "of a type that is not supported"),
    "more strides than sizes": (*weights_that(strides=sizes(27, 9, 3, 1, 1)), "4 sizes and 5 strides"),
    "a hundred dimensions": (*weights_that(sizes=sizes(*[1] * 100), strides=sizes(*[1] * 100)), "absurd size"),
    "a symbolic size": (*weights_that(sizes=[{"as_expr": {"expr_str": "s0"}}] * 4), r"\(KeyError\)"),
    "a fraction for a size": (*weights_that(sizes=sizes(4.0, 3, 3, 3)), "4.0 for a whole number"),
    "overlapping weights": (*weights_that(strides=sizes(0, 0, 0, 0)), None),
    "a pickle by its flag": (WEIGHTS, lambda c: c["config"]["conv.weight"].update(use_pickle=True), "as a pickle"),
    "a flag of another type": (WEIGHTS, lambda c: c["config"]["conv.weight"].update(use_pickle=0), "as a pickle"),
    "a path out": (WEIGHTS, lambda c: c["config"]["conv.weight"].update(path_name="../../x"), "as a pickle"),
    "a path on": (WEIGHTS, lambda c: c["config"]["conv.weight"].update(path_name="weight_0/../x"), "stored nowhere"),
    "no tensors": (WEIGHTS, lambda c: c.clear(), r"\(KeyError\)"),
    "a missing weight": (WEIGHTS, lambda c: c["config"].pop("conv.bias"), "the weight 'conv.bias', which it does"),
    "the same weight twice": (PROGRAM, lambda c: spec(c)[1].update(spec(c)[0]), "'conv.weight', .* or twice"),
    "one name for two values": (PROGRAM, twice, "twice, or no name"),
    "a value from later": (PROGRAM, cycle, "before it is computed"),
    "a value from nowhere": (PROGRAM, lambda c: argument(c, "sub", 0)["as_tensor"].update(name="y"), "'y' before it"),
    "no nodes": (PROGRAM, lambda c: c["graph_module"]["graph"].pop("nodes"), r"\(KeyError\)"),
    "nodes of another type": (PROGRAM, lambda c: c["graph_module"]["graph"].update(nodes=7), r"\(TypeError\)"),
    "a list for the program": (PROGRAM, lambda c: c.update(graph_module=[]), r"\(TypeError\)"),
    "two kinds in one": (PROGRAM, lambda c: argument(c, "sub", 0).update(as_int=1), "'as_int': 1} for an argument"),
    "an operator as argument": (
        PROGRAM,
        lambda c: nodes(c)[0]["inputs"][0].update(arg={"as_operator": "os.system"}),
        "an argument of kind 'as_operator'",
    ),
    "a graph as argument": (
        PROGRAM,
        lambda c: nodes(c)[0]["inputs"][0].update(arg={"as_graph": {"name": "g", "graph": {}}}),
        "an argument of kind 'as_graph'",
    ),
    "a custom object": (
        PROGRAM,
        lambda c: nodes(c)[0]["inputs"][0].update(arg={"as_custom_obj": {"name": "o", "class_fqn": "os"}}),
        "an argument of kind 'as_custom_obj'",
    ),
    "a token for an input": (PROGRAM, lambda c: spec(c).append({"token": {"arg": {"name": "t"}}}), "of kind 'token'"),
    "a second input": (PROGRAM, lambda c: spec(c).append(spec(c)[-1]), "2 inputs"),
    "an argument of no name": (PROGRAM, lambda c: nodes(c)[0]["inputs"][0].update(name="x"), "the argument 'x' of"),
    "an argument twice": (PROGRAM, lambda c: nodes(c)[0]["inputs"][1].update(name="self"), "an argument twice"),
    "text with code": (PROGRAM, lambda c: argument(c, "gelu", 1).update(as_string="__import__('os')"), "'as_string'"),
    "training mode": (PROGRAM, lambda c: argument(c, "batch_norm", 5).update(as_bool=True), "in training mode"),
    "a mutated buffer": (
        PROGRAM,
        lambda c: c["graph_module"]["signature"]["output_specs"].append({"buffer_mutation": {}}),
        r"outputs \['user_output', 'buffer_mutation'\]",
    ),
    "a weight that is changed": (PROGRAM, weight_changed, "it changes its weights"),
    "sixty doublings": (PROGRAM, grown, "a tensor of an absurd size"),
    "a size to the power of 2^80": (PROGRAM, squared, "a size is too large"),
    "a huge pad": (PROGRAM, lambda c: argument(c, "zeros", 0).update(as_ints=[1 << 40]), "a tensor of an absurd size"),
    "absurd size, place unsaid": (
        PROGRAM,
        lambda c: node(c, "zeros").update(inputs=[{"name": "size", "arg": {"as_ints": [1 << 40]}, "kind": 1}]),
        "a tensor of an absurd size",
    ),
    "a long list": (PROGRAM, lambda c: argument(c, "zeros", 0).update(as_ints=[1] * 2000), "more than 1024 items"),
    "depth that is not read": (PROGRAM, nested(800), None),
    "a batch of a billion": (PROGRAM, first_size({"as_int": 10**9}), "1000000000 for a whole number from 1 to"),
    "a batch of none": (PROGRAM, first_size({"as_int": 0}), "0 for a whole number from 1"),
    "a least batch of a billion": (PROGRAM, constrained(10**9, None), "1000000000 for a whole number from 1 to 4096"),
    "a range upside down": (PROGRAM, constrained(8, 4), "4 for a whole number from 8"),
    "a range in words": (PROGRAM, constrained("1", 4), "'1' for a whole number"),
    "a formula for the batch": (PROGRAM, first_size({"as_expr": {"expr_str": "s0**s0**s0"}}), r"the shape 's0\*\*s0"),
    "another layout": (PROGRAM, lambda c: c["schema_version"].update(major=9), "layout 9 of its description, not 8"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_hostile_descriptions(name, hostile, watch):
    member, change, sentence = CHANGES[name]
    result = answer(hostile.edit(member, change), watch)
    if sentence is None:
        assert isinstance(result, Tensor)
    else:
        assert re.search(sentence, str(result)), result


def test_kernels_that_check_no_sizes_are_not_called_themselves():
    """Called directly, the attention reads memory that is not its own here, and so do the others or they may."""

    def compute(name, *arguments):
        return operator_named(f"torch.ops.aten.{name}.default")[0](*arguments)

    one, picture = torch.rand(1), torch.rand(2, 4, 3, 3)
    q, k = torch.rand(16, 4, 32, 8), torch.rand(1, 1, 32, 8)
    expected = (q @ k.mT / 8**0.5).softmax(-1) @ k
    torch.testing.assert_close(compute("_scaled_dot_product_flash_attention_for_cpu", q, k, k)[0], expected)
    for name, arguments in {
        "_native_batch_norm_legit_no_training": (picture, one, one, one, one, 0.1, 1e-5),
        "native_group_norm": (picture, one, one, 2, 400, 9, 2, 1e-5),
        "as_strided": (picture, [2, 4, 3, 3], [36, 9, 1, 3]),
        "as_strided ": (picture, [2, 4, 3, 4], [36, 9, 3, 1]),
    }.items():
        with pytest.raises(RuntimeError):
            compute(name.strip(), *arguments)


def test_more_operators_than_any_network_has_are_refused(hostile, watch, monkeypatch):
    monkeypatch.setattr(description, "MAX_STEPS", len(nodes(json.loads(hostile.members[f"{hostile.root}/{PROGRAM}"]))))
    assert isinstance(answer(hostile, watch), Tensor)
    hostile.edit(PROGRAM, lambda c: nodes(c).append(nodes(c)[0]))
    assert f"more than {description.MAX_STEPS} operators" in answer(hostile, watch)


TEXTS = {
    b"[" * 100_000 + b"]" * 100_000: r"\(RecursionError\)|cannot be read",
    b'{"graph_module": NaN}': "NaN, which is no JSON",
    b'{"graph_module": 1, "graph_module": 2}': "the same key twice",
    b'{"schema_version": {"major": 8e999}}': "layout inf",
    b'{"schema_version": {"major": ' + b"9" * 5000 + b"}}": r"\(ValueError\)|layout 9999",
    b"\xff\xfe\x00": "cannot be read",
    b"": "cannot be read",
    b"[]": r"\(TypeError\)",
    b"null": r"\(TypeError\)",
    b" " * ((32 << 20) + 1): "more than 32 MiB",
}


@pytest.mark.parametrize("text", TEXTS, ids=lambda text: repr(text[:24]))
def test_hostile_texts(text, hostile, watch):
    assert re.search(TEXTS[text], str(answer(hostile.add(PROGRAM, text), watch)))


# ------------------------------------------------------------------------------------------------ the zip around it


@pytest.mark.parametrize("name", ["/etc/evil", "//evil", "../evil", "a/../../evil", "C:\\evil", "b/models/model.json"])
def test_members_outside_the_archives_folder_are_refused(name, hostile, watch):
    hostile.members[name] = b"x"
    assert re.search("the usual members|an older layout", str(answer(hostile, watch)))


@pytest.mark.parametrize(
    "name",
    "data/weights/model.pt data/constants/model.pt data/weights/evil.pkl code/__init__.py data.pkl models/evil.json "
    "data/constants/custom_obj_0 data/constants/opaque_obj_0 data/aotinductor/model/evil.so constants.pkl".split(),
)
def test_pickles_and_libraries_in_every_place_are_refused(name, hostile, watch):
    refusal = answer(hostile.add(name, hostile.torch_pickle()), watch)
    assert re.search("a pickle or an older layout|the usual members", str(refusal))


@pytest.mark.parametrize("name", ["data/weights/weight_0", "archive_version", "byteorder", "archive_format"])
def test_pickles_in_the_place_of_members_are_never_read_as_such(name, hostile, watch):
    result = answer(hostile.add(name, hostile.torch_pickle()), watch)
    assert isinstance(result, str)  # as numbers it is nonsense


def test_pickles_where_honest_files_have_them_are_not_read(hostile, watch, truth):
    result = answer(hostile.add("data/sample_inputs/model.pt", hostile.torch_pickle()), watch)
    assert torch.equal(result, truth)


def rewritten(hostile: Hostile, change) -> Hostile:
    """The archive written by a function of its zip file."""

    def write() -> Path:
        with zipfile.ZipFile(hostile.path, "w") as archive:
            for name, content in hostile.members.items():
                archive.writestr(name, content)
            change(archive)
        return hostile.path

    hostile.write = write
    return hostile


def test_a_member_twice_and_a_link_for_a_member_are_refused(hostile, watch):
    def twice(archive):
        with pytest.warns(UserWarning, match="Duplicate"):
            archive.writestr(f"{hostile.root}/{PROGRAM}", b"{}")

    assert "the usual members" in str(answer(rewritten(hostile, twice), watch))

    link = zipfile.ZipInfo(f"{hostile.root}/data/weights/weight_99")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    linked = answer(rewritten(hostile, lambda archive: archive.writestr(link, "/etc/passwd")), watch)
    assert isinstance(linked, Tensor)  # five bytes of text that nothing asks for: nothing is ever unpacked


def test_bombs_are_refused_before_they_are_unpacked(hostile, watch):
    name = f"{hostile.root}/data/weights/weight_77"
    bomb = rewritten(hostile, lambda archive: archive.writestr(name, bytes(20 << 20), zipfile.ZIP_DEFLATED))
    assert "members are larger than the file" in str(answer(bomb, watch))


def test_a_directory_that_lies_about_sizes_and_places_does_no_harm(hostile, watch):
    whole = hostile.write().read_bytes()
    entry = whole.index(b"PK\x01\x02")
    for field, value in ((20, 0xFFFFFF), (24, 0xFFFFFFF0), (24, 0), (42, 0x7FFFFFFF), (42, entry), (8, 1), (10, 99)):
        lying = bytearray(whole)
        struct.pack_into("<H" if field in (8, 10) else "<I", lying, entry + field, value)
        hostile.path.write_bytes(lying)
        hostile.write = lambda: hostile.path
        answer(hostile, watch)  # zipfile heeds one of the two places where a size stands, and the checksum
