"""Steps of programs: weighed before they are computed, and rewritten to what computes the same with fewer copies."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional as F

from patchproof.networks import graph
from patchproof.networks.onnx_file import read_onnx

pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')

from onnx_files import constants, model

ATEN = torch.ops.aten


def _meta(*shape, dtype=torch.float32):
    return torch.empty(shape, dtype=dtype, device="meta")


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
    ours, torchs = graph._SHAPE_ONLY[operator](*arguments), operator(*arguments)
    assert (ours.shape, ours.dtype, ours.stride()) == (torchs.shape, torchs.dtype, torchs.stride())


def program(body: str, **weights) -> graph.Program:
    """The steps of an ONNX graph, with some of its weights changed."""
    made = model(body)
    for tensor in made.graph.initializer:
        if tensor.name in weights:
            tensor.raw_data = weights[tensor.name].numpy().tobytes()
    return read_onnx(made.SerializeToString(), lambda location: b"")[0]


def names(network: graph.Program) -> list[str]:
    return [getattr(step.compute, "__name__", "") for step in network.steps]


def check_alike(network, truth, photos: torch.Tensor) -> None:
    """Answers and their squares' gradients; pictures stay as they were."""
    before = photos.clone()
    for ours, theirs in zip(answered(network, photos), answered(truth, photos), strict=True):
        torch.testing.assert_close(ours, theirs)
    with torch.no_grad():
        torch.testing.assert_close(network(photos), truth(photos))
    assert torch.equal(photos, before)


def answered(network, photos):
    photos = photos.clone().requires_grad_()
    answers = network(photos)
    return answers.detach(), torch.autograd.grad(answers.square().sum(), photos)[0]


def weights(*chosen: str) -> list[torch.Tensor]:
    return [torch.from_numpy(constants()[name]) for name in chosen]


def test_activations_write_over_what_nobody_else_has():
    network = program("""
        a = Conv<pads=[1,1,1,1]>(x, W) b = Clip(a, Zero, Two) c = Add(a, b) d = Relu(c)
        e = Conv(x, W) f = Flatten(e) g = Relu(f) h = ReduceMean<keepdims=0>(g, [1])
        i = Relu(x) j = ReduceMean<keepdims=0>(i, [1, 2, 3]) k = ReduceMean<keepdims=0>(d, [1, 2, 3])
        l = Add(h, j) m = Add(k, l) y = Unsqueeze(m, [1])
    """)
    activations = [name for name in names(network) if "relu" in name or "hardtanh" in name]
    # used twice; made by an addition for it alone; through a view; the pictures themselves
    assert activations == ["hardtanh.default", "relu_.default", "relu.default", "relu.default"]
    (kernel,) = weights("W")

    def truth(photos):
        first, view = F.conv2d(photos, kernel, padding=1), F.conv2d(photos, kernel).flatten(1)
        means = F.relu(first + F.hardtanh(first, 0, 2)).mean((1, 2, 3)), F.relu(view).mean(1), F.relu(photos)
        return (means[0] + means[1] + means[2].mean((1, 2, 3)))[:, None]

    check_alike(network, truth, torch.randn(2, 3, 8, 8))


def test_limits_in_place_have_the_gradients_of_limits_beside():
    kernel = weights("W")[0].round()
    network = program("a = Conv(x, W) y = Clip(a, Zero, Two)", W=kernel)
    assert names(network) == ["convolution.default", "_hardtanh_"]
    photos = torch.randint(-1, 2, (2, 3, 8, 8)).float()
    made = F.conv2d(photos, kernel)
    assert min(int((made == limit).sum()) for limit in (0, 2)) > 5, "many lie at the limits"
    check_alike(network, lambda x: F.hardtanh(F.conv2d(x, kernel), 0, 2), photos)


ASIDE = {  # paddings, and what else the convolution has; whether they lie within its weights
    (0, 0, 1, 1): ("strides=[2,2], group=3", True),
    (2, 3, 2, 2): ("group=3", True),
    (3, 1, 2, 0): ("strides=[1,2], group=3", True),
    (0, 0, 1, 1, 0): ("strides=[2,2]", False),  # of more colors
    (0, 0, 1, 1, 1): ("dilations=[2,2], group=3", False),
    (0, 0, 1, 2): ("group=3", False),  # two columns
    (0, -1, 0, 0): ("group=3", False),  # less than there was
}


@pytest.mark.parametrize("sides", ASIDE)
def test_more_zeros_on_one_side_are_zeros_in_small_weights(sides):
    options, within = ASIDE[sides]
    top, left, bottom, right = sides[:4]
    name = "D" if "group" in options else "W"
    network = program(f"y = Conv<pads=[{top},{left},{bottom},{right}], {options}>(x, {name})")
    assert names(network) == ["constant_pad_nd.default"] * (not within) + ["convolution.default"]
    (kernel,) = weights(name)
    stride, dilation = ([2, 2] if "[2,2]" in options and word in options else [1, 1] for word in ("stri", "dila"))
    stride = [1, 2] if "[1,2]" in options else stride
    groups = 3 if name == "D" else 1

    def truth(photos):
        return F.conv2d(F.pad(photos, (left, right, top, bottom)), kernel, None, stride, 0, dilation, groups)

    check_alike(network, truth, torch.randn(2, 3, 8, 8))


@pytest.mark.parametrize("second", ["D", "d", "e"])
def test_weights_that_several_convolutions_share_stay_as_they_are(second):
    """Also under other names."""
    network = program(f"""d = Identity(D) e = Identity(D) a = Conv<pads=[0,0,1,1], group=3>(x, d)
        b = Conv<pads=[0,0,1,1], group=3>(x, {second}) y = Add(a, b)""")
    (kernel,) = weights("D")
    check_alike(network, lambda x: 2 * F.conv2d(F.pad(x, (0, 1, 0, 1)), kernel, groups=3), torch.randn(2, 3, 8, 8))


def test_even_zeros_are_a_convolutions_own():
    assert names(program("y = Conv<pads=[2,1,2,1]>(x, W)")) == ["convolution.default"]


@pytest.mark.parametrize(
    ("bound", "limit", "step"),
    [
        ("MAX_VALUES", 9 * 192, "Relu(x)"),
        ("MAX_PRODUCTS", 8 * 8 * 3 * 8, "MatMul(x, x)"),
        ("MAX_PRODUCTS", 8 * 8 * 3 * 9, "MaxPool<kernel_shape = [3, 3], pads = [1, 1, 1, 1]>(x)"),
        ("MAX_PRODUCTS", 8 * 8 * 3 * 9, "AveragePool<kernel_shape = [3, 3], pads = [1, 1, 1, 1]>(x)"),
    ],
)
def test_a_network_that_asks_for_too_much_is_refused_before_anything_is_computed(bound, limit, step, monkeypatch):
    """3,000 products of matrices of 1,024 numbers a side took an hour; each of them is small enough by itself."""
    body = "\n".join(["a0 = Identity(x)", *(f"a{i + 1} = {step.replace('(x', f'(a{i}')}" for i in range(8))])
    network = program(f"{body}\ny = Flatten(a8)")
    monkeypatch.setattr(graph, bound, limit)
    photos = torch.rand(2, 3, 8, 8)
    network.dry_run(len(network.steps), photos.shape)
    monkeypatch.setattr(graph, bound, limit - 1)
    network.tested.clear()
    with pytest.raises(ValueError, match="too many computations"):
        network.dry_run(len(network.steps), photos.shape)
