"""Exported programs, honest and hostile: what an archive wants to execute must never happen."""

import json
import shutil
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path

import pytest
import torch
from archives import LABELS, ConvNeXt, Hostile, ResNet, Small, ViT, exported, save, seeded

from patchproof.base.strict import Refused
from patchproof.classifier import center_square, load_classifier, program
from patchproof.classifier.program import load_program
from patchproof.networks import graph


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    path = save(tmp_path_factory.mktemp("honest"), exported(Small()))
    with zipfile.ZipFile(path) as archive:
        if not any(name.endswith("model_weights_config.json") for name in archive.namelist()):
            pytest.skip(f"torch {torch.__version__} saves weights as pickles, which are refused; 2.9 does not")
    return path


@pytest.fixture
def hostile(tmp_path, honest) -> Hostile:
    return Hostile(tmp_path, honest)


def refused(hostile: Hostile, sentence: str) -> None:
    """The archive is refused in one sentence that matches, and nothing of it was executed."""
    with pytest.raises(Refused, match=sentence) as caught:
        load_classifier(f"file:{hostile.write()}", hostile.path.parent)
    assert not hostile.executed()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700


def torch_executes(hostile: Hostile) -> bool:
    """Whether torch alone executes what is in the archive: without it a test of a refusal would prove nothing."""
    try:
        torch.export.load(str(hostile.write())).module()(torch.rand(2, 3, 16, 16))
    except Exception:  # whatever it says after the deed
        pass
    return hostile.executed()


def node(content: dict) -> dict:
    return content["graph_module"]["graph"]["nodes"][-1]


def pickled_weight(hostile: Hostile) -> Hostile:
    config = "data/weights/model_weights_config.json"
    hostile.add("data/weights/weight_0", hostile.torch_pickle())
    return hostile.edit(config, lambda c: [meta.update(use_pickle=True) for meta in c["config"].values()])


def pickled_constant(hostile: Hostile) -> Hostile:
    config = "data/constants/model_constants_config.json"
    hostile.add("data/constants/tensor_0", hostile.torch_pickle())
    return hostile.edit(config, lambda c: [meta.update(use_pickle=True) for meta in c["config"].values()])


def opaque_constant(hostile: Hostile) -> Hostile:
    config = "data/constants/model_constants_config.json"
    meta = {"path_name": "opaque_obj_0", "is_param": False, "use_pickle": True, "tensor_meta": None}
    hostile.add("data/constants/opaque_obj_0", hostile.pickle())
    return hostile.edit(config, lambda c: c["config"].update(evil=meta))


def legacy_weights(hostile: Hostile) -> Hostile:
    return hostile.add("data/weights/model.pt", hostile.torch_pickle())


def shape_expression(hostile: Hostile) -> Hostile:
    def change(content):
        photos = content["graph_module"]["graph"]["tensor_values"]["x"]
        photos["sizes"][0]["as_expr"]["expr_str"] = hostile.python()

    return hostile.edit("models/model.json", change)


def enum_in_a_tree(hostile: Hostile) -> Hostile:
    module = hostile.path.with_name("evil_enum.py")
    module.write_text(hostile.python())

    def change(content):
        call = content["graph_module"]["module_call_graph"][0]["signature"]
        protocol, spec = json.loads(call["in_spec"])
        spec["children_spec"][1]["context"] = json.dumps([{"__enum__": True, "fqn": "evil_enum:A", "name": "B"}])
        call["in_spec"] = json.dumps([protocol, spec])

    return hostile.edit("models/model.json", change)


def default_of_an_argument(hostile: Hostile) -> Hostile:
    """Where torch writes the graph as Python, an input is an argument, and its name may bring a default value."""

    def change(content):
        name = f"x=({hostile.python()})"
        graph = content["graph_module"]["graph"]
        text = json.dumps(content).replace('"name": "x"', f'"name": {json.dumps(name)}')
        content.update(json.loads(text))
        content["graph_module"]["graph"]["tensor_values"][name] = graph["tensor_values"]["x"]

    return hostile.edit("models/model.json", change)


EXECUTABLE = {
    pickled_weight: "stored as a pickle",
    pickled_constant: "stored as a pickle",
    opaque_constant: "opaque_obj_0",
    legacy_weights: "data/weights/model.pt, a pickle or an older layout: save the network with torch.export.save",
    shape_expression: 'the shape "__import__',
}
HARMLESS = [enum_in_a_tree, default_of_an_argument]  # not read, or only compared with other names


def _meta(*shape, dtype=torch.float32):
    return torch.empty(shape, dtype=dtype, device="meta")


ATEN = torch.ops.aten
PHOTOS, KERNEL = _meta(2, 6, 17, 16), _meta(8, 6, 3, 5)


@pytest.mark.parametrize(
    ("operator", "arguments"),
    [
        (ATEN.convolution.default, (PHOTOS, KERNEL, None, [1, 1], [0, 0], [1, 1], False, [0, 0], 1)),
        (ATEN.convolution.default, (PHOTOS, KERNEL, _meta(8), [2, 3], [1, 4], [2, 1], False, [0, 0], 1)),
        (ATEN.convolution.default, (PHOTOS, _meta(6, 1, 3, 3), None, [2, 2], [1, 1], [1, 1], False, [0, 0], 6)),
        (ATEN.convolution.default, (PHOTOS, _meta(6, 8, 3, 3), None, [2, 2], [1, 1], [1, 1], True, [1, 0], 1)),
        (ATEN.convolution.default, (PHOTOS[0], _meta(8, 17, 3), None, [1], [0], [1], False, [0], 1)),
        (ATEN.add.Tensor, (PHOTOS, _meta(6, 1, 1))),
        (ATEN.mul.Tensor, (_meta(6, 1, 1), PHOTOS)),
        (ATEN.sub.Tensor, (PHOTOS, _meta(16, dtype=torch.float64))),
        (ATEN.div.Tensor, (PHOTOS, 2.0)),
        (ATEN.hardtanh.default, (PHOTOS.permute(0, 2, 3, 1),)),
        (ATEN.mean.dim, (PHOTOS, [2, -1], True)),
        (ATEN.mean.dim, (PHOTOS, [-3])),
        (ATEN.mean.dim, (PHOTOS, None)),
    ],
)
def test_programs_are_weighed_by_the_sizes_that_torch_would_say(operator, arguments):
    ours, torchs = graph._WEIGHED[operator](*arguments), operator(*arguments)
    assert (ours.shape, ours.dtype, ours.stride()) == (torchs.shape, torchs.dtype, torchs.stride())


def test_a_program_of_common_operators_starts_without_torchs_compiler(tmp_path):
    """Torch imports it, and SymPy, for tensors without memory: two seconds of every command."""

    class Common(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.first, self.last = torch.nn.Conv2d(3, 4, 3, 2), torch.nn.Conv2d(4, len(LABELS), 1)

        def forward(self, photos):
            return self.last(torch.nn.functional.relu6(self.first(photos - 0.5))).mean((2, 3))

    path = save(tmp_path, exported(Common()))
    load = f"load_classifier('file:{path}', Path('.'))"
    loaded = "assert not {'torch._dynamo', 'sympy'} & sys.modules.keys(), 'imported'"
    code = f"import sys; from pathlib import Path; from patchproof.classifier import load_classifier; {load}; {loaded}"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("make", [*EXECUTABLE, *HARMLESS], ids=lambda make: make.__name__)
def test_what_torch_would_execute_is_not_executed(make, hostile, monkeypatch):
    monkeypatch.syspath_prepend(hostile.path.parent)
    assert torch_executes(make(hostile)), "this archive is harmless, the test proves nothing"
    if make in EXECUTABLE:
        refused(hostile, EXECUTABLE[make])
    else:
        classifier = load_classifier(f"file:{hostile.path}", hostile.path.parent)
        assert classifier.logits(torch.rand(5, 3, 40, 30)).shape == (5, 4)
        assert not hostile.executed()


def test_hostile_sample_inputs_and_guards_are_left_out(hostile):
    hostile.add("data/sample_inputs/model.pt", hostile.torch_pickle())
    assert torch_executes(hostile)
    classifier = load_classifier(f"file:{hostile.path}", hostile.path.parent)
    assert not hostile.executed()
    assert classifier.logits(torch.rand(5, 3, 40, 30)).shape == (5, 4)

    hostile.edit("models/model.json", lambda c: c.update(guards_code=[hostile.python()]))
    assert torch_executes(hostile)
    load_classifier(f"file:{hostile.write()}", hostile.path.parent).logits(torch.rand(5, 3, 40, 30))
    assert not hostile.executed()


@pytest.mark.parametrize(
    "target",
    [
        "torch.ops.aten.save.default",
        "torch.ops.aten.from_file.default",
        "torch.ops.aten.relu.__class__",
        "torch.ops.aten.__class__.mro",
        "torch.ops.higher_order.cond",
        "torch.os.mkdir",
        "torch.hub.load",
        "_operator.methodcaller",
        "math.__loader__.load_module",
        "#extension:x",
        "relu",
    ],
)
def test_operators_that_are_not_on_the_list_are_refused(target, hostile):
    hostile.edit("models/model.json", lambda c: node(c).update(target=target))
    refused(hostile, "with the operator '" + target.replace(".", "\\."))


@pytest.mark.parametrize(
    "name", ["data/aotinductor/model/x.so", "../evil.json", "models/other.json", "code/x.py", "data.pkl"]
)
def test_members_that_are_not_on_the_list_are_refused(name, hostile):
    refused(hostile.add(name, b"x"), "pickle" if name == "data.pkl" else "the usual members")


def test_a_second_member_of_the_same_name_is_refused(hostile):
    hostile.write()
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(hostile.path, "a") as archive:
        archive.writestr(f"{hostile.root}/models/model.json", b"{}")
    with pytest.raises(Refused, match="usual members"):
        load_program(hostile.path)


def test_absurd_sizes_are_refused(hostile):
    def huge(content):
        for meta in content["config"].values():
            meta["tensor_meta"]["sizes"] = [{"as_int": 1 << 40}]

    refused(hostile.edit("data/weights/model_weights_config.json", huge), "absurd size")


def test_a_file_of_absurd_size_is_refused_unread(hostile, monkeypatch):
    hostile.write()
    monkeypatch.setattr(program, "MAX_BYTES", 1000)
    monkeypatch.setattr(Path, "read_bytes", lambda self: pytest.fail("it was read"))
    with pytest.raises(Refused, match="which is larger"):
        load_program(hostile.path)


def test_a_compressed_bomb_is_refused(hostile):
    hostile.add("data/weights/weight_7", bytes(50_000_000))
    with zipfile.ZipFile(hostile.path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in hostile.members.items():
            archive.writestr(name, content)
    with pytest.raises(Refused, match="members are larger than the file"):
        load_program(hostile.path)


def test_files_that_are_no_whole_archive_are_refused(hostile):
    whole = hostile.write().read_bytes()
    flipped = bytearray(whole)
    flipped[whole.index(b"graph_module") + 3] ^= 1  # one bit: the zip's checksum no longer fits
    for content in (whole[: len(whole) // 2], bytes(flipped), b"", hostile.pickle(), whole[:-30], b"PK\x03\x04"):
        hostile.path.write_bytes(content)
        with pytest.raises(
            Refused, match=r"(no whole zip archive|a pickle or an older layout).*: save the network with"
        ):
            load_program(hostile.path)
        assert not hostile.executed()


def test_pickles_by_name_or_in_disguise_are_refused(hostile):
    hostile.path.write_bytes(hostile.torch_pickle())
    with pytest.raises(Refused, match=r"with archive/data.pkl, a pickle"):
        load_program(hostile.path)
    for suffix in (".pt", ".pth", ".pkl", ".pt2.bin"):
        other = hostile.path.with_suffix(suffix)
        other.write_bytes(hostile.pickle())
        with pytest.raises(Refused, match=r"save it with torch\.export\.save as NAME"):
            load_classifier(f"file:{other}", other.parent)
    assert not hostile.executed()


@pytest.mark.parametrize(
    ("card", "sentence"),
    [
        (None, r"Expected a JSON file, got no file at .*hostile\.json: write"),
        ("{", "that cannot be read"),
        ("[]", "input_px"),
        ('{"input_px": "16", "labels": ["a", "b"]}', "input_px.*'16'"),
        ('{"input_px": 16, "labels": ["a"]}', "labels, a list of two or more names"),
        ('{"input_px": 16, "labels": "names.json"}', r"no file at .*names\.json: lay the list of labels there"),
        ('{"input_px": 16, "labels": ["a", "b", "c"]}', "3 logits for each picture.*\\(3, 4\\)"),
        ('{"input_px": 12, "labels": ["a", "b", "c", "d"]}', "takes N×3×S×S pictures"),
    ],
)
def test_a_card_that_is_missing_or_wrong_is_refused(card, sentence, hostile):
    if card is None:
        hostile.path.with_suffix(".json").unlink()
    else:
        hostile.path.with_suffix(".json").write_text(card)
    refused(hostile, sentence)


def test_an_honest_program_gives_the_networks_logits_and_gradients(honest):
    classifier = load_classifier("file:small.pt2", honest.parent)
    assert (classifier.name, classifier.input_px, list(classifier.labels)) == ("file:small.pt2", 16, LABELS)
    assert len(classifier.sha256) == 64
    photos = torch.rand(70, 3, 16, 16, requires_grad=True)  # more than the 64 that the program takes at once
    torch.testing.assert_close(classifier.logits(photos), seeded(Small())(photos))
    ours, theirs = (torch.autograd.grad(f(photos)[:, 0].sum(), photos)[0] for f in (classifier.logits, seeded(Small())))
    torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(classifier.logits(photos[:1]), classifier.logits(photos)[:1])


@pytest.mark.parametrize("make", [ResNet, ViT, ConvNeXt])
def test_logits_and_gradients_are_torchs_also_when_decomposed(make, tmp_path, honest):
    program = exported(make())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of itself
        decomposed = program.run_decompositions()
    truth = program.module()
    for network in (load_program(save(tmp_path, form)).network for form in (program, decomposed)):
        for batch, order in ((1, torch.contiguous_format), (5, torch.contiguous_format), (5, torch.channels_last)):
            photos = torch.rand(batch, 3, 16, 16).to(memory_format=order)
            (logits, gradient), (expected, true_gradient) = (answered(f, photos) for f in (network, truth))
            torch.testing.assert_close(logits, expected, rtol=1e-5, atol=1e-5)
            torch.testing.assert_close(gradient, true_gradient, rtol=1e-5, atol=1e-5)


def answered(network, photos):
    """Logits and the gradient of their squares."""
    photos = photos.clone().requires_grad_()
    logits = network(photos)
    return logits.detach(), torch.autograd.grad(logits.square().sum(), photos)[0]


def test_a_program_of_one_batch_size_takes_any_number(tmp_path, honest):
    classifier = load_program(save(tmp_path, exported(Small(), batch=3)))
    photos = torch.rand(7, 3, 16, 16)
    torch.testing.assert_close(classifier.logits(photos), seeded(Small())(photos))


def test_labels_may_lie_in_a_list_beside_the_card(tmp_path, honest):
    shutil.copy(honest, tmp_path / "n.pt2")
    (tmp_path / "n.json").write_text('{"input_px": 16, "labels": "list.json"}')
    (tmp_path / "list.json").write_text(json.dumps(LABELS))
    assert load_program(tmp_path / "n.pt2").labels == tuple(LABELS)


def test_real_networks_recognize_a_photograph(data):
    import numpy as np
    from PIL import Image

    photo = np.asarray(Image.open(data / "photos" / "skimage_coffee.png").convert("RGB")).copy()
    photo = torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255
    for name in ("mobilenet_v1_0.25_128", "squeezenet1.1_224"):
        classifier = load_classifier(f"file:${{PATCHPROOF_DATA}}/models/{name}.pt2", Path("."))
        assert classifier.logits(photo).argmax() == 967  # espresso
        square = center_square(photo, classifier.input_px)
        truth = torch.export.load(str(data / "models" / f"{name}.pt2")).module()
        for ours, theirs in zip(answered(classifier.network, square), answered(truth, square), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-5 * float(theirs.abs().max()))


class Rectified(torch.nn.Module):
    """Three activations; only of the last nobody else has what it rectifies."""

    def __init__(self):
        super().__init__()
        self.convs = torch.nn.ModuleList(torch.nn.Conv2d(3, 4, 3, padding=1) for _ in range(2))

    def forward(self, x):
        first, view = self.convs[0](x), self.convs[1](x).flatten(2)
        again = torch.nn.functional.relu6(first) - first  # used twice
        seen = torch.relu(view)  # through a view
        return (again + torch.relu(first + 0.1)).flatten(2).mean(2) + seen.mean(2) + x.mean((1, 2, 3))[:, None]


def test_activations_write_over_what_nobody_else_has(tmp_path, honest):
    module, photos = seeded(Rectified()), torch.randn(2, 3, 16, 16).requires_grad_()
    network = load_classifier(f"file:{save(tmp_path, exported(module))}", tmp_path).network
    names = [str(step.compute) for step in network.network.steps]
    assert {name: names.count(name) for name in names if "relu" in name} == {
        "aten.relu6.default": 1, "aten.relu.default": 1, "aten.relu_.default": 1,
    }  # fmt: skip
    before = photos.detach().clone()
    answers = network(photos), module(photos)
    torch.testing.assert_close(*answers)
    torch.testing.assert_close(*(torch.autograd.grad(answer[:, 1].sum(), photos)[0] for answer in answers))
    assert torch.equal(photos, before)


class Limited(torch.nn.Module):
    """Activations with two limits, each of what was made for it alone."""

    def __init__(self):
        super().__init__()
        self.convs = torch.nn.ModuleList(torch.nn.Conv2d(3, 4, 1) for _ in range(3))
        self.limits = (torch.nn.functional.relu6, torch.nn.Hardtanh(), torch.nn.Hardtanh(-3, 2.0))

    def forward(self, x):
        seen = [conv(limit(x + 1)) for conv, limit in zip(self.convs, self.limits, strict=True)]
        return torch.stack(seen).sum(0).mean((2, 3))


def test_limits_in_place_have_the_gradients_of_limits_beside(tmp_path, honest):
    module, photos = seeded(Limited()), torch.randint(-4, 7, (2, 3, 16, 16)).float()  # many lie at the limits
    network = load_program(save(tmp_path, exported(module))).network.network
    names = [getattr(step.compute, "__name__", "") for step in network.steps]
    assert (names.count("_hardtanh_"), names.count("_relu6_")) == (2, 1)
    for ours, theirs in zip(answered(network, photos), answered(module, photos), strict=True):
        torch.testing.assert_close(ours, theirs)
    torch.testing.assert_close(network(photos), module(photos))


class Padded(torch.nn.Module):
    """Zeros around, in every way that a convolution's own padding can or cannot say."""

    def __init__(self):
        super().__init__()
        self.convs = torch.nn.ModuleList(torch.nn.Conv2d(3, 3, 3, padding=p) for p in (0, 0, (1, 0), 0, 0, 0, 0))

    def forward(self, x):
        pad, (even, uneven, own, ones, mirrored, shared, cut) = torch.nn.functional.pad, self.convs
        both = pad(x, (1, 1, 1, 1))
        found = (
            even(pad(x, (1, 1, 2, 2))), own(pad(x, (3, 3, 1, 1), value=0.0)),  # become their own
            uneven(pad(x, (0, 1, 0, 1))), ones(pad(x, (1, 1, 1, 1), value=1.0)), cut(pad(x, (-1, -1, 1, 1))),
            mirrored(pad(x, (1, 1, 1, 1), mode="reflect")), shared(both), both,
        )  # fmt: skip
        return torch.stack([values.square().mean((2, 3)) for values in found]).sum(0)


class PaddedAside(torch.nn.Module):
    """More zeros on one side, before convolutions of a color each that can have them within, and others."""

    def __init__(self):
        super().__init__()
        within = [{"stride": 2}, {"padding": (2, 1)}, {"stride": (1, 2), "kernel_size": (3, 5)}]
        without = [{"groups": 1}, {"dilation": 2}, {}]
        self.convs = torch.nn.ModuleList(
            torch.nn.Conv2d(3, 6, **({"kernel_size": 3, "groups": 3} | changed)) for changed in within + without
        )

    def forward(self, x):
        sides = ((0, 1, 0, 1), (2, 1, 0, 0), (1, 0, 3, 2), (0, 1, 0, 1), (0, 1, 0, 1), (0, 2, 0, 1))
        found = [conv(torch.nn.functional.pad(x, side)) for conv, side in zip(self.convs, sides, strict=True)]
        return torch.stack([values.square().mean((2, 3)) for values in found]).sum(0)[:, :4]


def test_more_zeros_on_one_side_are_zeros_in_small_weights(tmp_path, honest):
    module, photos = seeded(PaddedAside()), torch.randn(2, 3, 16, 16)
    network = load_program(save(tmp_path, exported(module))).network.network
    weights = len(list(network.buffers()))
    padded = [step.arguments[0].number for step in network.steps if "pad" in str(step.compute)]
    assert [number < weights for number in padded].count(True) == 3, padded
    assert padded.count(weights) == 3
    for ours, theirs in zip(answered(network, photos), answered(module, photos), strict=True):
        torch.testing.assert_close(ours, theirs)


@pytest.mark.parametrize("decomposed", [False, True])
def test_zeros_around_a_picture_are_a_convolutions_own_where_it_can_say_so(decomposed, tmp_path, honest):
    module, photos = seeded(Padded()), torch.randn(2, 3, 16, 16)
    form = exported(module)
    if decomposed:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of itself
            form = form.run_decompositions()
    network = load_program(save(tmp_path, form)).network.network
    kept = [str(step.compute) for step in network.steps if "pad" in str(step.compute)]
    assert len([name for name in kept if "reflection" not in name]) == 5 - decomposed, kept
    for ours, theirs in zip(answered(network, photos), answered(module, photos), strict=True):
        torch.testing.assert_close(ours, theirs)
