"""ONNX files as networks: what they answer, beside torch, onnx's own reference and the same weights in memory."""

import json
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_networks import LABELS, ConvNeXt, ResNet, ViT, seeded

from patchproof.app.verify import options_of
from patchproof.base.errors import Refused
from patchproof.classifier import load_classifier
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.network_file import EXPORT_ADVICE, load_network
from patchproof.evidence.gather import gather_evidence
from patchproof.networks import batches
from patchproof.networks.batches import Windows, tune_batches
from patchproof.networks.bounds import UnsupportedNetwork
from patchproof.networks.onnx_file import OPSETS, read_onnx
from patchproof.networks.onnx_operators import FIXED_ATTRIBUTES, OPERATORS, REFUSED, Operator
from patchproof.sheets.manifest import load_manifest
from test_zoo import judged

pytest.importorskip("onnx", reason='needs onnx, of the extra "test"')

import onnx_files
from onnx import defs
from onnx.reference import ReferenceEvaluator


class Prompted(ViT):
    """CLIP's way: cosines with the embeddings of prompts, which are constants."""

    def __init__(self):
        super().__init__()
        self.prompts = torch.nn.Parameter(torch.zeros(4, 4))

    def forward(self, x):
        seen, said = (torch.nn.functional.normalize(y, dim=-1) for y in (super().forward(x), self.prompts))
        return 10 * seen @ said.T


def written(folder: Path, network: torch.nn.Module, batch: int | None = None, side: int = 16) -> Path:
    """`network` for N×3×16×16 or another side, by torch's older exporter, of any N or of one."""
    path = folder / "net.onnx"
    axes = {"input_names": ["x"], "dynamic_axes": None if batch else {"x": {0: "n"}}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of itself
        torch.onnx.export(seeded(network), (torch.rand(batch or 2, 3, side, side),), str(path), dynamo=False, **axes)
    path.with_suffix(".json").write_text(json.dumps({"input_px": side, "labels": LABELS}))
    return path


def answered(network, photos):
    """Logits and the gradient of their squares."""
    photos = photos.clone().requires_grad_()
    logits = network(photos)
    return logits.detach(), torch.autograd.grad(logits.square().sum(), photos)[0]


def check_alike(network, truth, numbers=(1, 5)) -> None:
    for number in numbers:
        photos = torch.rand(number, 3, 16, 16, generator=torch.Generator().manual_seed(number))
        for ours, theirs in zip(answered(network, photos), answered(truth, photos), strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("batch", [None, 1])
@pytest.mark.parametrize("make", [ResNet, ViT, ConvNeXt, Prompted])
def test_logits_and_gradients_are_torchs(make, batch, tmp_path):
    check_alike(load_network(written(tmp_path, make(), batch)).network, seeded(make()))


def test_the_command_of_the_refusal_writes_such_a_file_with_weights_beside_it(tmp_path, monkeypatch):
    pytest.importorskip("onnxscript", reason="torch's newer exporter needs onnxscript")
    monkeypatch.chdir(tmp_path)
    code, _, _ = EXPORT_ADVICE.removeprefix("export it with ").partition(", S pixels")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of itself
        exec(code.replace("NAME", "net"), {"torch": torch, "network": seeded(ViT()), "S": 16})
    path = tmp_path / "net.onnx"
    path.with_suffix(".json").write_text(json.dumps({"input_px": 16, "labels": LABELS}))
    assert (tmp_path / "net.onnx.data").stat().st_size > 1000
    classifier = load_network(path)
    check_alike(classifier.network, seeded(ViT()))
    with (tmp_path / "net.onnx.data").open("r+b") as data:
        data.write(b"\1")
    assert load_network(path).sha256 != classifier.sha256  # what is hashed is both files
    (tmp_path / "net.onnx.data").unlink()
    with pytest.raises(Refused, match=r"no file at .*net\.onnx\.data"):
        load_network(path)


def test_file_and_module_of_the_same_weights_agree_for_photographs_of_any_size(tmp_path):
    network, photos = seeded(ResNet()), torch.rand(5, 3, 40, 30)
    names = [f"file:{written(tmp_path, network)}", classifier_of(network, 16, LABELS)]
    ours, theirs = (answered(load_classifier(name, tmp_path).logits, photos) for name in names)
    assert ours[1].abs().max() > 1e-3
    torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("order", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("make", [ResNet, ViT, ConvNeXt])
def test_pictures_may_come_in_either_order(make, order, tmp_path):
    network, truth = load_network(written(tmp_path, make())).network.network, seeded(make())
    photos = torch.rand(5, 3, 16, 16).to(memory_format=order)
    for ours, theirs in zip(answered(network, photos), answered(truth, photos), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-5)


def test_a_file_is_cut_where_its_module_is(tmp_path, monkeypatch):
    """Gradients in windows are the whole network's there, and are computed there only."""
    monkeypatch.setattr(batches, "CUT_COST", 0)  # the network is small
    pictures = torch.rand(2, 3, 96, 96)
    network, of_module = (
        load_network(written(tmp_path, ResNet(), side=96)).network,
        tune_batches(seeded(ResNet()), pictures),
    )
    assert tune_batches(network, pictures).cut and of_module.cut and network.cut.stride == of_module.cut.stride
    px = np.array([[40, 30, 50, 44], [0, 0, 9, 9], [80, 85, 96, 96]])
    photos, gradients = torch.rand(3, 3, 96, 96), []
    for asked in (None, Windows(px)):
        given = photos.clone().requires_grad_()
        gradients.append(torch.autograd.grad(network(given, asked).square().sum(), given)[0])
    whole, parts = gradients
    for one, same, (left, top, right, bottom) in zip(parts, whole, px.tolist(), strict=True):
        torch.testing.assert_close(one[:, top:bottom, left:right], same[:, top:bottom, left:right])
    assert not torch.equal(parts, whole)


def test_a_file_goes_from_a_scene_to_a_verdict(tmp_path):
    builtin = load_builtin()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        axes = {"input_names": ["x"], "dynamic_axes": {"x": {0: "n"}}}
        torch.onnx.export(builtin.network, (torch.rand(2, 3, 96, 96),), str(tmp_path / "b.onnx"), dynamo=False, **axes)
    (tmp_path / "b.json").write_text(json.dumps({"input_px": 96, "labels": list(builtin.labels)}))
    run, report = judged(tmp_path, "file:b.onnx", "carton")
    assert run.promise.models[0].name == "file:b.onnx"
    sheet = tmp_path / "sheet.json"
    manifest = load_manifest(sheet)
    options = replace(options_of(sheet, manifest, ["builtin"]), ledger_photos=0)
    again = gather_evidence(tmp_path / "photos", manifest, options)
    pairs = [(a.predictions, b.predictions) for a, b in zip(report.photos, again.photos, strict=True) if a.predictions]
    assert pairs
    for ours, theirs in pairs:
        assert ours["file:b.onnx"].target_confidence == pytest.approx(theirs["builtin"].target_confidence, abs=1e-4)


def test_a_file_has_a_name_a_hash_and_its_card_s_labels(tmp_path):
    onnx_files.save(tmp_path, onnx_files.small())
    classifier = load_classifier("file:small.onnx", tmp_path)
    assert (classifier.name, classifier.input_px, list(classifier.labels)) == ("file:small.onnx", 8, onnx_files.LABELS)
    assert len(classifier.sha256) == 64 and not any(p.requires_grad for p in classifier.network.buffers())
    with pytest.raises(Refused, match=r'write "file:small\.onnx"'):
        load_classifier("small.onnx", tmp_path)


# --- each operator, beside onnx's reference ---

REDUCTIONS = "ReduceMean ReduceMax ReduceMin ReduceL2 ReduceSum ReduceProd ReduceL1 ReduceSumSquare".split()
UNARY = """Sinh Cosh Tan Asinh Atan Round Softsign Selu Celu ThresholdedRelu Shrink LpNormalization Det ReduceLogSumExp
Trilu Abs Ceil Cos Erf Exp Floor Neg Relu Sigmoid Sign Sin Tanh HardSwish Mish
Softplus Elu LeakyRelu HardSigmoid GlobalAveragePool GlobalMaxPool Gelu Softmax LogSoftmax Flatten Transpose
Dropout""".split()
BODIES = [
    *(f"y = {name}(x)" for name in UNARY),
    *(f"a = Exp(x) y = {name}(a)" for name in ("Log", "Reciprocal", "Sqrt", "Acosh", "ReduceLogSum")),
    *(f"a = Tanh(x) y = {name}(a)" for name in ("Asin", "Acos", "Atanh")),
    *(f"y = {name}(x, C)" for name in "Add Sub Mul Div PRelu Max Min Sum Mean CastLike".split()),
    *(f"a = {name}(x, Zero) y = Cast<to=1>(a)" for name in "Equal Greater GreaterOrEqual Less LessOrEqual".split()),
    *(f"y = {name}(x, [1, -1])" for name in REDUCTIONS),
    *(f"y = {name}<keepdims=0>(x)" for name in "ReduceMean ReduceMax ReduceMin ReduceSum ReduceL2".split()),
    *(f"y = {name}<noop_with_empty_axes=1>(x)" for name in REDUCTIONS),
    "a = Log(x) b = IsNaN(a) y = Cast<to=1>(b)",
    *(
        f"a = Div(x, Zero) b = IsInf{signs}(a) y = Cast<to=1>(b)"
        for signs in ("", "<detect_negative=0>", "<detect_positive=0>")
    ),
    "a = Less(x, Zero) b = Less(x, Two) c = Xor(a, b) y = Cast<to=1>(c)",
    "a = Cast<to=7>(x) b = BitwiseNot(a) c = BitwiseAnd(b, [3]) d = BitwiseOr(c, a) y = BitwiseXor(d, [5])",
    *(f'a = Abs(x) b = Cast<to=2>(a) y = BitShift<direction="{way}">(b, b)' for way in ("LEFT", "RIGHT")),
    "y = Selu<alpha=2.0, gamma=3.0>(x)",
    "y = Celu<alpha=0.5>(x)",
    "y = ThresholdedRelu<alpha=0.3>(x)",
    "y = Shrink<lambd=0.3, bias=0.1>(x)",
    "y = LpNormalization<axis=1, p=2>(x)",
    "y = ArgMax<axis=1, keepdims=0>(x)",
    "y = ReduceLogSumExp<noop_with_empty_axes=1>(x)",
    "a = Exp(x) y = ReduceLogSum<noop_with_empty_axes=1>(a)",
    "y = ArgMin<axis=2, keepdims=0>(x)",
    *(f"a = Round(x) y = Arg{end}<axis=3, select_last_index=1>(a)" for end in ("Max", "Min")),
    *(f"b = Round(x) a, y = TopK<axis=3, largest={largest}, sorted=1>(b, [5])" for largest in (0, 1)),
    *(
        f"a = Squeeze([-1]) y = CumSum<exclusive={exclusive}, reverse={reverse}>(x, a)"
        for exclusive, reverse in ((0, 0), (1, 0), (1, 1))
    ),
    "y = Trilu<upper=0>(x)",
    "k = Squeeze([-2]) y = Trilu(x, k)",
    *(f"a = Flatten(x) y = EyeLike{kind}(a)" for kind in ("", "<k=1, dtype=7>")),
    *(f'a = Concat<axis=1>(x, x, x, x) y = DepthToSpace<blocksize=2, mode="{mode}">(a)' for mode in ("DCR", "CRD")),
    "y = SpaceToDepth<blocksize=4>(x)",
    "a = Shape(x) b = NonZero(a) c = Cast<to=1>(b) y = Add(c, Two)",
    "y = Size(x)",
    "i = Cast<to=7>(x) a = Mod(i, [8]) y = GatherElements<axis=3>(x, a)",
    *(f"i = Reshape([0, 1, 1, -1], [2, 2]) y = GatherND<batch_dims={count}>(x, i)" for count in (0, 1)),
    *(
        f'i = Cast<to=7>(x) a = Mod(i, [8]) y = ScatterElements<axis=3, reduction="{kind}">(x, a, x)'
        for kind in ("add", "mul", "max", "min")
    ),
    "i = Reshape([-2], [1, 1, 1, 1]) u = Reshape(Two, [1, 1, 1, 1]) y = ScatterElements<axis=2>(x, i, u)",
    *(
        f'p = Reshape([-1], [1, 1]) w = Gather<axis=0>(x, [0]) y = ScatterND<reduction="{kind}">(x, p, w)'
        for kind in ("add", "mul", "max", "min")
    ),
    "a = Less(x, Zero) b = Greater(x, Two) c = Or(a, b) d = Not(c) e = Or(a, d) f = And(e, d) y = Cast<to=1>(f)",
    "y = Elu<alpha=0.5>(x)",
    "y = LeakyRelu<alpha=0.3>(x)",
    "y = HardSigmoid<alpha=0.1666667, beta=0.4>(x)",
    'y = Gelu<approximate="tanh">(x)',
    "y = Softmax<axis=1>(x)",
    "y = LogSoftmax<axis=2>(x)",
    "y = Cast<to=7>(x)",
    "a = Mul(x, Two) b = Cast<to=7>(a) y = Div(b, [-3])",
    "a = Mul(x, Two) b = Cast<to=7>(a) y = Mod(b, [-3])",
    "y = Mod<fmod=1>(x, Two)",
    "y = Pow(x, Two)",
    "a = Less(x, Zero) y = Where(a, C, x)",
    "y = Clip(x, Zero, Two)",
    "y = Clip(x, Two, Zero)",
    "y = Clip(x, , Zero)",
    "a = Neg(Two) y = Clip(x, a, Two)",
    "y = MatMul(x, M)",
    "a = Flatten<axis=3>(x) y = Gemm(a, M)",
    "a = ReduceMean<keepdims=0>(x, [0, 1]) y = Gemm<transA=1, alpha=0.5, beta=2.0>(a, M, Two)",
    "a = Flatten<axis=3>(x) b = Transpose(M) y = Gemm<transB=1>(a, b)",
    'y = Einsum<equation="bchw,wk->bkch">(x, M)',
    "y = Conv(x, W)",
    "y = Conv<strides=[2,1], dilations=[1,2], pads=[1,0,2,3], kernel_shape=[3,3]>(x, W, F)",
    "y = Conv<group=3, pads=[1,1,1,1]>(x, D)",
    "y = Conv<group=3, strides=[2,2], pads=[0,0,1,1]>(x, D)",
    "y = Conv<strides=[2,1], dilations=[1,2], pads=[1,0,2,3]>(x, W)",
    "w = Mul(W, Two) y = Conv<pads=[1,0,2,3]>(x, w)",
    "a = Reshape(x, [0, 0, 64]) w = Reshape(W, [4, 3, 9]) y = Conv(a, w)",
    'y = Conv<auto_pad="VALID">(x, W)',
    "y = MaxPool<kernel_shape=[3,3], strides=[2,2], pads=[1,1,1,1]>(x)",
    "y = MaxPool<kernel_shape=[3,3], strides=[2,2], pads=[0,0,1,1]>(x)",
    "y = MaxPool<kernel_shape=[3,3], strides=[2,2], ceil_mode=1>(x)",
    "y = AveragePool<kernel_shape=[3,3], strides=[2,2], pads=[1,1,1,1]>(x)",
    "y = AveragePool<kernel_shape=[3,3], pads=[0,1,1,1], count_include_pad=1>(x)",
    'y = AveragePool<kernel_shape=[3,3], strides=[2,2], auto_pad="VALID">(x)',
    "y = AveragePool<kernel_shape=[3,3], strides=[2,2], ceil_mode=1>(x)",
    "y = AveragePool<kernel_shape=[3,2], strides=[3,2], pads=[1,1,1,1], count_include_pad=1>(x)",
    *(f'y = Conv<auto_pad="SAME_{end}", strides=[2, 3], dilations=[2, 1]>(x, W, F)' for end in ("UPPER", "LOWER")),
    'y = MaxPool<auto_pad="SAME_UPPER", kernel_shape=[3, 2], strides=[2, 2]>(x)',
    'y = AveragePool<auto_pad="SAME_UPPER", kernel_shape=[3, 2], strides=[1, 2]>(x)',
    *(
        f"y = AveragePool<kernel_shape=[3, 3], strides=[2, 2], pads=[0, 1, 2, 1], ceil_mode=1, "
        f"dilations={dilations}, count_include_pad={counted}>(x)"
        for dilations in ([1, 1], [2, 2])
        for counted in (0, 1)
    ),
    "a = Reshape(x, [0, 0, 64]) y = MaxPool<kernel_shape=[3], strides=[2]>(a)",
    "a = Reshape(x, [2, 12, 16]) y = Col2Im<strides=[2, 2], pads=[0, 1, 2, 1]>(a, [6, 6], [2, 2])",
    "a = Reshape(x, [2, 12, 16]) y = Col2Im<dilations=[2, 1]>(a, [6, 5], [2, 2])",
    *(
        f"w = Transpose<perm=[1, 0, 2, 3]>(W) y = ConvTranspose<strides=[2, 2], {places}>(x, w, F)"
        for places in (
            "pads=[1, 1, 1, 1]",
            "pads=[0, 1, 2, 1], output_padding=[1, 1], dilations=[2, 1], kernel_shape=[3, 3]",
            'auto_pad="SAME_UPPER"',
            'auto_pad="SAME_LOWER"',
        )
    ),
    "y = ConvTranspose<group=3>(x, D)",
    *(
        f"b = Transpose<perm=[0, 2, 3, 1]>(x) a = Slice(b, [0], [2], [3]) "
        f'y = GridSample<mode="{mode}", padding_mode="{padding}", align_corners={corners}>(x, a)'
        for mode, padding, corners in (("linear", "zeros", 0), ("nearest", "border", 0), ("nearest", "reflection", 1))
    ),
    *(
        f"a = Slice(x, [0, 0, 0], [1, 2, 3], [1, 2, 3]) t = Squeeze(a, [1]) "
        f"y = AffineGrid<align_corners={corners}>(t, [2, 3, 4, 5])"
        for corners in (0, 1)
    ),
    "y = BatchNormalization(x, S, P, S, P)",
    "a = Reshape(W, [1, 4, -1]) b = BatchNormalization<training_mode=1>(a, F, F, F, F) "
    "c = Reshape(b, [4, 3, 3, 3]) y = Conv(x, c)",
    "y = BatchNormalization<epsilon=0.1, momentum=0.5>(x, S, P, S, P)",
    "a = Transpose<perm=[0,2,3,1]>(x) y = LayerNormalization<epsilon=0.1>(a, S, P)",
    "y = LayerNormalization<axis=2, stash_type=1>(x, Square)",
    "y = InstanceNormalization(x, S, P)",
    "y = InstanceNormalization<epsilon=0.1>(x, S, P)",
    "a = Identity(x) y = Relu(a)",
    *(f"y = Reshape(x, {sizes})" for sizes in ([0, -1], [0, 0, 64], [-1, 8, 24])),
    "y = Reshape<allowzero=1>(x, [-1, 192])",
    "y = Flatten<axis=2>(x)",
    "a = GlobalAveragePool(x) y = Squeeze(a, [2, -1])",
    "a = GlobalAveragePool(x) y = Squeeze(a)",
    "y = Unsqueeze(x, [0, -1])",
    "y = Transpose<perm=[2,0,3,1]>(x)",
    "y = Concat<axis=-1>(x, x)",
    "a, b = Split<axis=2, num_outputs=2>(x) y = Sub(b, a)",
    "a, b = Split<axis=1>(x, [1, 2]) y = Concat<axis=1>(b, a)",
    "y = Slice(x, [1, -3], [7, 100], [2, -1])",
    "y = Slice(x, [-1, 6], [-9223372036854775807, 0], [2, 3], [-1, -2])",
    "y = Slice(x, [5], [2], [3])",
    "y = Gather<axis=2>(x, [1, -1, 0])",
    "a = Squeeze([-2]) y = Gather<axis=1>(x, a)",
    "a = Squeeze([0]) b = Squeeze([1]) s = Shape(x) n = Gather(s, a) y = Range(a, n, b)",
    "p = Reshape([1], [-1, 1]) w = Gather<axis=0>(x, [0]) y = ScatterND(x, p, w)",
    "a = ReduceMean(x, [2]) y = Expand(a, [2, 1, 3, 4, 8])",
    "y = Tile(x, [1, 2, 1, 3])",
    "y = Pad(x, [0, 0, 1, 2, 0, 0, 3, 0], Two)",
    *(f'y = Pad<mode="{mode}">(x, [0, 0, 1, 2, 0, 1, 3, 9])' for mode in ("edge", "wrap")),
    'y = Pad<mode="reflect">(x, [0, 0, 1, 2, 0, 2, 3, 7])',
    'y = Pad<mode="edge">(x, [1, 2, 0, 3], , [2, 3])',
    *(f"s = Shape<start={n}>(x) v = ConstantOfShape<value=float[1] {{2.5}}>(s) y = Add(x, v)" for n in (1, 4)),
    "s = Shape(x) r = ReduceProd<keepdims=0>(s) y = Add(s, r)",
    *(
        f'y = Resize<mode="{mode}", coordinate_transformation_mode="{corners}", nearest_mode="floor">(x, , {factors})'
        for factors in ([1.0, 1.0, 2.0, 2.0], [1.0, 1.0, 0.5, 2.0])
        for mode, corners in (("nearest", "asymmetric"), ("linear", "half_pixel"), ("cubic", "half_pixel"))
    ),
    *(
        f'y = Resize<mode="nearest", nearest_mode="round_prefer_{end}">(x, , {factors})'
        for end, factors in (("floor", [1.0, 1.0, 2.0, 3.0]), ("ceil", [1.0, 1.0, 0.5, 0.25]))
    ),
    'y = Resize<mode="linear", antialias=0, exclude_outside=0, keep_aspect_ratio_policy="stretch">(x, , , [2,3,5,9])',
    *(
        f'y = Resize<mode="linear", axes=[3, 2], keep_aspect_ratio_policy="not_{end}">(x, , , [13, 5])'
        for end in ("larger", "smaller")
    ),
    'y = Resize<coordinate_transformation_mode="asymmetric", nearest_mode="ceil">(x, , [1.0, 1.0, 1.3, 0.6])',
    *(
        f'y = Resize<mode="{mode}", cubic_coeff_a=-0.5, exclude_outside={excluded}, antialias={wide}>(x, , {factors})'
        for mode, excluded, wide, factors in (
            ("linear", 0, 1, [1.0, 1.0, 0.5, 0.6]),
            ("cubic", 1, 1, [1.0, 1.0, 0.5, 0.6]),
            ("cubic", 1, 0, [1.0, 2.0, 1.3, 2.7]),
        )
    ),
    'y = Resize<mode="linear", coordinate_transformation_mode="pytorch_half_pixel">(x, , , [2, 3, 1, 8])',
    "a = Shape<end=2>(x) b = Concat<axis=0>(a, [11, 5]) "
    'y = Resize<mode="linear", coordinate_transformation_mode="align_corners">(x, , , b)',
]
OTHER_OPSETS = [
    *((13, f"y = {name}<axes=[1, 3], keepdims=0>(x)") for name in REDUCTIONS if name != "ReduceSum"),
    (13, "a, b = Split<axis=2>(x) y = Sub(b, a)"),
    (11, "y = ReduceSum<axes=[1], keepdims=0>(x)"),
    (11, "a = GlobalAveragePool(x) b = Squeeze<axes=[2, 3]>(a) y = Unsqueeze<axes=[0]>(b)"),
    (11, "a, b = Split<axis=2, split=[3, 5]>(x) y = Concat<axis=2>(b, a)"),
    (7, "y = Clip<min=0.0, max=2.0>(x)"),
    (7, "y = Clip<max=1.0>(x)"),
    (7, "y = Pad<pads=[0, 0, 1, 2, 0, 0, 3, 1], value=2.0>(x)"),
    (9, "y = Slice<axes=[2], starts=[1], ends=[-1]>(x)"),
    (11, "y, mask = Dropout<ratio=0.4>(x)"),
    (23, "y = RMSNormalization<axis=2, epsilon=0.1>(x, Square)"),
    (21, "a = Concat<axis=1>(x, x, x, x) y = GroupNormalization<num_groups=2>(a, E, E)"),
    (18, "a = Concat<axis=1>(x, x) y = GroupNormalization<num_groups=3, epsilon=0.1>(a, S, P)"),
]


@pytest.mark.parametrize(("opset", "body"), [*((20, body) for body in BODIES), *OTHER_OPSETS])
def test_an_operator_is_onnxs(opset, body):
    made = onnx_files.model(body, opset)
    pictures = np.random.default_rng(1).normal(size=(2, 3, 8, 8)).astype("f")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # logarithms of negative numbers
        (expected,) = ReferenceEvaluator(made).run(None, {"x": pictures})
    network, batch, _ = read_onnx(made.SerializeToString(), lambda location: b"")
    assert batch is None
    got = network(torch.from_numpy(pictures)).numpy()
    assert (got.dtype, got.shape) == (expected.dtype, expected.shape)
    np.testing.assert_allclose(got, expected, rtol=1e-4, atol=1e-5)
    elsewhere = network.to("meta")(torch.empty(2, 3, 8, 8, device="meta"))  # constants follow to any device
    assert elsewhere.shape == got.shape


# [opset, body, shape, sum of the result times cos 0, cos 1, cos 2, ...] by onnxruntime 1.32, where onnx's reference
# cannot compute a body or computes it otherwise
BY_ONNXRUNTIME = json.loads((Path(__file__).parent / "onnxruntime_values.json").read_text())


@pytest.mark.parametrize(("opset", "body", "shape", "value"), BY_ONNXRUNTIME)
def test_an_operator_is_onnxruntime_s(opset, body, shape, value):
    pictures = np.random.default_rng(1).normal(size=(2, 3, 8, 8)).astype("f")
    network, *_ = read_onnx(onnx_files.model(body, opset).SerializeToString(), lambda location: b"")
    got = network(torch.from_numpy(pictures)).numpy().astype("d")
    assert list(got.shape) == shape
    assert (got.reshape(-1) * np.cos(np.arange(got.size))).sum() == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_operators_of_torch_s_own_take_part_in_what_is_saved():
    body = """a = Conv<group=3, pads=[0,0,1,1]>(x, D) b = Clip(a, Zero, Two) c = Conv(b, W) d = Conv(b, W)
        e = Add(c, d) y = Relu(e)"""
    network, *_ = read_onnx(onnx_files.model(body).SerializeToString(), lambda location: b"")
    names = [getattr(step.compute, "__name__", "") for step in network.steps]
    assert names == ["convolution.default", "_hardtanh_", *["convolution.default"] * 2, "add.Tensor", "relu_.default"]
    network, *_ = read_onnx(onnx_files.model("y = Conv(x, W, F)").SerializeToString(), lambda location: b"")
    assert isinstance(network.steps[0].compute, Operator)  # which sends a short bias to the pictures' device


def test_every_operator_of_the_table_is_tried():
    tried = {node.op_type for node in tried_nodes()}
    assert set(OPERATORS) <= tried


def tried_nodes() -> list:
    bodies = [*((20, body) for body in (*BODIES, MAX_POOL.format([0] * 4, 0, [1, 1]))), *OTHER_OPSETS]
    bodies += [(opset, body) for opset, body, _, _ in BY_ONNXRUNTIME]
    return [node for opset, body in bodies for node in onnx_files.model(body, opset).graph.node]


def test_what_the_standard_has_is_in_the_table_or_refused_with_a_reason():
    every = [each for each in defs.get_all_schemas_with_history() if not each.domain and each.since_version < 25]
    schemas = {each.name for each in every if defs.get_schema(each.name).since_version >= 7 or not each.deprecated}
    others = {name for names in REFUSED.values() for name in names.split()}
    assert schemas - others - {"Constant", "Identity"} <= set(OPERATORS) and not others & set(OPERATORS)
    with pytest.raises(UnsupportedNetwork, match="the operator 'Unique', which has results whose size depends"):
        read_onnx(onnx_files.model("y = Unique(x)").SerializeToString(), lambda location: b"")


MAX_POOL = 'y = MaxPool<kernel_shape=[3,2], strides=[2,3], pads={}, ceil_mode={}, dilations={}, auto_pad="NOTSET">(x)'
MAX_POOL_PADS = ([0, 0, 0, 0], [1, 1, 1, 1], [0, 0, 1, 1], [2, 0, 1, 1], [1, 0, 2, 1])


@pytest.mark.parametrize("dilations", [[1, 1], [2, 3]])
@pytest.mark.parametrize("ceil", [0, 1])
@pytest.mark.parametrize("pads", MAX_POOL_PADS)
def test_no_window_of_a_max_pool_begins_in_the_padding_behind_the_picture(pads, ceil, dilations):
    """Counted out by hand: onnx's reference counts such windows, onnxruntime does not."""
    pictures = np.random.default_rng(2).normal(size=(1, 3, 8, 8)).astype("f")
    places = []
    for kernel, stride, dilation, before, after in zip([3, 2], [2, 3], dilations, pads[:2], pads[2:], strict=True):
        starts = range(-before, 8 + after - (kernel - 1) * dilation + ceil * (stride - 1), stride)
        windows = [range(start, start + kernel * dilation, dilation) for start in starts if start < 8]
        places.append([[place for place in window if 0 <= place < 8] for window in windows])
    rows, columns = places
    expected = [[pictures[..., row, :][..., column].max((2, 3)) for column in columns] for row in rows]
    body = MAX_POOL.format(pads, ceil, dilations)
    network, *_ = read_onnx(onnx_files.model(body).SerializeToString(), lambda location: b"")
    got = network(torch.from_numpy(pictures)).numpy()
    np.testing.assert_array_equal(got, np.transpose(expected, (2, 3, 0, 1)))


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ('y = Conv<auto_pad="VALID", pads=[1,1,1,1]>(x, W)', "auto_pad"),
        (
            "y = Conv<kernel_shape=[5,5], pads=[1,1,1,1]>(x, W)",
            r"weights of \(4, 3, 3, 3\) for kernel_shape = \[5, 5\]",
        ),
        ("y = MaxPool<kernel_shape=[2,2], pads=[2,2,2,2]>(x)", "with windows in its padding"),
    ],
)
def test_what_torch_computes_otherwise_is_refused(body, sentence):
    with pytest.raises((ValueError, UnsupportedNetwork), match=sentence):
        read_onnx(onnx_files.model(body).SerializeToString(), lambda location: b"")[0](torch.rand(2, 3, 8, 8))


def standard_attributes() -> set[tuple[str, str]]:
    """Operators of the table with each attribute that the standard lists for them in the opsets that are read."""
    found, schemas = set(), defs.get_all_schemas_with_history()
    for name in OPERATORS:
        versions = [each for each in schemas if each.name == name and not each.domain]
        first = max((each.since_version for each in versions if each.since_version <= OPSETS[0]), default=0)
        found |= {(name, word) for each in versions if each.since_version >= first for word in each.attributes}
    return found


def test_every_attribute_of_the_standard_is_tried_fixed_or_refused():
    """None is taken and left aside."""
    tried = {(node.op_type, attribute.name) for node in tried_nodes() for attribute in node.attribute}
    refused = set()
    for name, word in standard_attributes():
        operator = OPERATORS[name]
        if word not in operator.fixed and word not in operator.signature.parameters:
            with pytest.raises(UnsupportedNetwork, match="unsupported inputs or attributes"):
                operator.check([None], {word: 1})
            refused.add((name, word))
    fixed = {(name, word) for name, words in FIXED_ATTRIBUTES.items() for word in words}
    assert standard_attributes() <= tried | fixed | refused
    assert fixed <= standard_attributes() and len(refused) < 20
    for name, words in FIXED_ATTRIBUTES.items():
        for word, value in words.items():
            attributes = {word: value if value is not None else 1}
            with suppress(UnsupportedNetwork):  # of inputs
                OPERATORS[name].check([], attributes)
            assert not attributes
            if value is not None:
                with pytest.raises(UnsupportedNetwork, match=f"the attribute {word} = "):
                    OPERATORS[name].check([], {word: "another"})
