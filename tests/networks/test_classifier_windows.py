"""Gradients in windows: the whole program's, for any place of the windows; and programs that cannot be cut."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_networks import ConvNeXt, ResNet, ViT, seeded

from patchlab.study.trained_designs import best_design
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.network import Classifier, _windows_in_square, center_square
from patchproof.networks import batches, cuts
from patchproof.networks.batches import Windows, tune_batches
from patchproof.networks.graph import Program, Step, ValueRef, mark_last_uses
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import CONTROLS, pictures_with_controls
from patchproof.optimizer.responses import responses
from test_optimize import scene_with, toml

ATEN = torch.ops.aten
SIZE = 128


@pytest.fixture(autouse=True)
def small_networks_save_too(monkeypatch):
    monkeypatch.setattr(batches, "CUT_COST", 0)


def program(*lines, sizes=(None, 3, None, None)) -> Program:
    """Lines (operator, arguments) as steps; in arguments, "x" is the pictures, an int in a tuple a line's result, from
    0, and a tensor a weight.
    """
    weights = [argument for _, arguments in lines for argument in arguments if isinstance(argument, torch.Tensor)]

    def value(argument):
        if isinstance(argument, torch.Tensor):
            return ValueRef(next(number for number, weight in enumerate(weights) if weight is argument))
        if isinstance(argument, tuple):
            return ValueRef(len(weights) + 1 + argument[0])
        if isinstance(argument, list):
            return [value(item) for item in argument]
        return ValueRef(len(weights)) if argument == "x" else argument

    steps = [
        Step(compute, [value(argument) for argument in arguments], {}, [len(weights) + 1 + number], False)
        for number, (compute, arguments) in enumerate(lines)
    ]
    output = len(weights) + len(steps)
    mark_last_uses(steps, {*range(len(weights) + 1), output})
    return Program(weights, steps, output, list(sizes))


def kernel(before: int, after: int, side: int = 3) -> torch.Tensor:
    return torch.randn(after, before, side, side) / (before * side**2) ** 0.5


def convolution(of, before: int, after: int, stride: int = 1, side: int = 3, padding: int | None = None):
    padding = side // 2 if padding is None else padding
    more = [[stride] * 2, [padding] * 2, [1, 1], False, [0, 0], 1]
    return ATEN.convolution.default, [of, kernel(before, after, side), torch.randn(after), *more]


def head(of, features: int):
    """The lines that end a program of as many features; `of` is the number of the line before."""
    return (
        (ATEN.mean.dim, [(of,), [2, 3]]),
        (ATEN.linear.default, [(of + 1,), torch.randn(5, features), torch.randn(5)]),
    )


def plain() -> Program:
    return program(
        convolution("x", 3, 16, 2),
        (ATEN.relu.default, [(0,)]),
        convolution((1,), 16, 16),
        (ATEN.hardtanh.default, [(2,), 0.0, 6.0]),
        convolution((3,), 16, 24, 2),
        (ATEN.hardswish.default, [(4,)]),
        *head(5, 24),
    )


def residual() -> Program:
    return program(
        (ATEN.sub.Tensor, ["x", torch.full((3, 1, 1), 0.5)]),
        (ATEN.constant_pad_nd.default, [(0,), [0, 1, 0, 1]]),
        convolution((1,), 3, 12, 2, padding=0),
        (ATEN.relu.default, [(2,)]),
        convolution((3,), 12, 12),
        (ATEN.relu.default, [(4,)]),
        (ATEN.add.Tensor, [(5,), (3,)]),
        (ATEN.max_pool2d.default, [(6,), [3, 3], [2, 2], [1, 1]]),
        convolution((7,), 12, 12),
        *head(8, 12),
    )


def joined() -> Program:
    """As in SqueezeNet: no zeros at the rim of its first layers, so that their sides are odd, and two paths."""
    return program(
        convolution("x", 3, 12, 2, padding=0),
        (ATEN.relu.default, [(0,)]),
        (ATEN.max_pool2d.default, [(1,), [3, 3], [2, 2], [0, 0], [1, 1], True]),
        convolution((2,), 12, 6, side=1),
        (ATEN.relu.default, [(3,)]),
        convolution((4,), 6, 8, side=1),
        convolution((4,), 6, 8),
        (ATEN.cat.default, [[(5,), (6,)], 1]),
        (ATEN.relu.default, [(7,)]),
        *head(8, 16),
    )


def gradient(answers, photos: torch.Tensor) -> torch.Tensor:
    photos = photos.clone(memory_format=torch.preserve_format).requires_grad_()
    found = answers(photos)
    return torch.autograd.grad((found * torch.linspace(-1, 2, found.numel()).view(found.shape)).sum(), photos)[0]


def pictures(count: int = 3) -> torch.Tensor:
    return torch.rand(count, 3, SIZE, SIZE).contiguous(memory_format=torch.channels_last)


@pytest.mark.parametrize("made", [plain, residual, joined])
@pytest.mark.parametrize("seed", range(4))
def test_the_gradient_in_windows_is_the_whole_programs(made, seed):
    torch.manual_seed(seed)
    network, photos, rng = made(), pictures(2), np.random.default_rng(seed)
    starts, sides = rng.integers(0, SIZE - 40, (2, 2)), rng.integers(1, 40, (2, 2))
    starts[0] = [(0, 0), (SIZE - 40, 0), (0, SIZE - 40), (SIZE - 40, SIZE - 40)][seed]
    sides[0] = 40  # up to the rim
    asked = np.hstack([starts, starts + sides])
    found = cuts._cuts(network, photos)
    assert len(found) >= 2
    whole = gradient(network, photos)
    for cut in found:
        parts = gradient(lambda x, cut=cut: cut.answers(x, Windows(asked)), photos)
        for one, same, (left, top, right, bottom) in zip(parts, whole, asked.tolist(), strict=True):
            here = slice(None), slice(top, bottom), slice(left, right)
            torch.testing.assert_close(one[here], same[here], rtol=1e-4, atol=1e-5 * float(whole.abs().max()))
    outside = parts.clone()
    for one, (left, top, right, bottom) in zip(outside, cut.rectangles(asked, SIZE).tolist(), strict=True):
        one[:, top:bottom, left:right] = 0
    assert not outside.any(), "what was not computed is 0, not what lay in memory"


def test_how_far_a_pixel_reaches_is_what_kernels_and_strides_say():
    found = {cut.steps: cut for cut in cuts._cuts(plain(), pictures())}
    # by hand: 3 at stride 2; 2 more steps of 2 px; 2 more of 2 px at stride 4
    assert [(c.steps, c.stride, c.low, c.high) for c in found.values()] == [
        (1, 2, -1, 1),
        (2, 2, -1, 1),
        (3, 2, -3, 3),
        (4, 2, -3, 3),
        (5, 4, -5, 5),
        (6, 4, -5, 5),
    ]
    assert found[4].numbers == 4 * 16 * (SIZE // 2) ** 2


def test_cuts_lie_where_one_value_is_left():
    assert [cut.steps for cut in cuts._cuts(residual(), pictures())] == [3, 4, 7, 8, 9]
    assert [cut.steps for cut in cuts._cuts(joined(), pictures())] == [1, 2, 3, 4, 5, 8, 9]


@pytest.mark.parametrize("less", [2, 3])
def test_a_cut_that_reaches_less_far_than_it_should_is_not_taken(monkeypatch, less):
    network, photos = plain(), pictures(2)
    cut = cuts.find_cut(network, photos)
    assert cut is not None and cuts._is_correct(network, cut, photos)
    narrow = replace(cut, low=cut.low + 2 * less, high=cut.high - 2 * less)
    monkeypatch.setattr(cuts, "STEP_PX", 4)  # rounding up hides a pixel or two
    assert cuts._is_correct(network, cut, photos) and not cuts._is_correct(network, narrow, photos)
    monkeypatch.setattr(cuts, "_cuts", lambda *_: [narrow])
    assert cuts.find_cut(network, photos) is None


def squeezes() -> Program:
    """Each picture's mean scales what follows, as in a squeeze-and-excitation block: every pixel reaches everything."""
    return program(
        (ATEN.mean.dim, ["x", [2, 3], True]),
        (ATEN.mul.Tensor, ["x", (0,)]),
        convolution((1,), 3, 8, 2),
        convolution((2,), 8, 8, 2),
        *head(3, 8),
    )


def of_one_size() -> Program:
    side = SIZE // 2
    return program(
        convolution("x", 3, 8, 2),
        (ATEN.view.default, [(0,), [-1, 4, 2, side, side]]),
        (ATEN.permute.default, [(1,), [0, 2, 1, 3, 4]]),
        (ATEN.reshape.default, [(2,), [-1, 8, side, side]]),
        convolution((3,), 8, 8, 2),
        *head(4, 8),
    )


def with_places() -> Program:
    return program(
        convolution("x", 3, 8, 2),
        (ATEN.add.Tensor, [(0,), torch.randn(1, 8, SIZE // 2, SIZE // 2)]),
        convolution((1,), 8, 8, 2),
        *head(2, 8),
    )


def pictures_again() -> Program:
    return program(
        convolution("x", 3, 3, 2),
        (ATEN.relu.default, [(0,)]),
        (ATEN.upsample_nearest2d.default, [(1,), [SIZE, SIZE]]),
        (ATEN.add.Tensor, [(2,), "x"]),
        *head(3, 3),
    )


def swallows_nan() -> Program:
    """A network whose own cleaning of numbers hides how far a pixel reaches."""
    return program(
        convolution("x", 3, 8, 2), (ATEN.nan_to_num.default, [(0,)]), convolution((1,), 8, 8, 2), *head(2, 8)
    )


def depends_without_gradient() -> Program:
    """The picture's mean, in steps that have no gradient, and cleaned of the NaN that would show how far it reaches."""
    return program(
        convolution("x", 3, 8, 2),
        (ATEN.mean.dim, ["x", [1, 2, 3], True]),
        (ATEN.nan_to_num.default, [(1,)]),
        (ATEN.mul.Tensor, [(2,), 1e5]),
        (ATEN.round.default, [(3,)]),
        (ATEN.add.Tensor, [(0,), (4,)]),
        convolution((5,), 8, 8, 2),
        *head(6, 8),
    )


def test_answers_that_depend_on_all_of_a_picture_without_a_gradient_are_not_shared(monkeypatch):
    torch.manual_seed(0)
    network, photos, asked = depends_without_gradient(), pictures(), np.array([[60, 50, 70, 60]] * 3)
    laid, other = tune_batches(network, photos), photos.clone()
    other[..., 50:60, 60:70] = 0
    with torch.no_grad():
        kept = {}
        for each in (photos, other):
            torch.testing.assert_close(laid(each, Windows(asked, kept)), network(each))
    assert laid.cut is None
    monkeypatch.setattr(cuts, "_are_close", lambda *_: True)
    assert cuts.find_cut(network, photos[:2]), "nothing else would have seen it"


@pytest.mark.parametrize("made", [squeezes, of_one_size, with_places, pictures_again, swallows_nan])
def test_programs_that_cannot_be_cut_give_their_whole_gradient(made):
    torch.manual_seed(0)
    network, photos, asked = made(), pictures(), np.array([[60, 50, 70, 60]] * 3)
    laid, plainly = tune_batches(network, photos), gradient(network, photos)
    assert torch.equal(gradient(lambda x: laid(x, Windows(asked)), photos), gradient(laid, photos))
    torch.testing.assert_close(gradient(laid, photos), plainly)


class Written(torch.nn.Module):
    """Functions, methods, places and a weight of its own in place of modules; activations in place."""

    def __init__(self):
        super().__init__()
        self.first, self.second = torch.nn.Conv2d(3, 8, 3, 2, 1), torch.nn.Conv2d(8, 8, 3, 2, 1)
        self.scale = torch.nn.Parameter(torch.rand(8, 1, 1))

    def forward(self, photos):
        halves = self.first(photos).relu_().chunk(2, 1)
        features = torch.cat((halves[1], halves[0]), 1) * self.scale
        features = torch.nn.functional.silu(self.second(features), inplace=True)
        return features[:, :, 1:, 1:].reshape(features.shape[0], 8, -1).mean(-1)


class Turns(Written):
    def forward(self, photos):
        return super().forward(photos if photos.mean() > 0 else -photos)


class Counts(Written):
    """What it does depends on how often it was called."""

    calls = 0

    def forward(self, photos):
        self.calls += 1
        return super().forward(photos * self.calls)


class Masked(Written):
    def forward(self, photos, mask=None):
        return super().forward(photos)


class Slices(Written):
    """Steps hold no places that depend on the pictures' size."""

    def forward(self, photos):
        return super().forward(photos[:, :, : photos.shape[2] // 2])


@pytest.mark.parametrize(("side", "is_cut"), [(96, True), (120, False), (100, False)])
def test_sides_that_strides_do_not_divide_are_left_whole(side, is_cut):
    photos = torch.rand(2, 3, side, side)
    assert (cuts.find_cut(plain(), photos) is not None) == is_cut


def asked_of(network, monkeypatch):
    """What a network will be asked in windows, once its cut is found."""
    assert network.cut
    found, calls = cuts.Cut.answers, []
    monkeypatch.setattr(cuts.Cut, "answers", lambda *given: calls.append(given) or found(*given))
    return calls


@pytest.mark.parametrize(("side", "used"), [(20, True), (56, True), (57, False), (SIZE, False)])
def test_windows_that_would_save_nothing_are_computed_as_ever(monkeypatch, side, used):
    laid, photos, asked = tune_batches(plain(), pictures()), pictures(), np.array([[0, 0, side, side]] * 3)
    calls = asked_of(laid, monkeypatch)
    torch.testing.assert_close(
        gradient(lambda x: laid(x, Windows(asked)), photos)[..., :side, :side],
        gradient(laid, photos)[..., :side, :side],
    )
    assert bool(calls) == used


@pytest.mark.parametrize(("side", "used"), [(20, True), (57, True), (88, True), (89, False), (SIZE, False)])
def test_answers_are_shared_up_to_larger_windows(monkeypatch, side, used):
    laid, first, asked = tune_batches(plain(), pictures()), pictures(), np.array([[0, 0, side, side]] * 3)
    other, calls = torch.rand_like(first), asked_of(laid, monkeypatch)
    other[..., side:], other[..., side:, :] = first[..., side:], first[..., side:, :]
    with torch.no_grad():
        kept = {}
        for photos in (first, other):
            torch.testing.assert_close(laid(photos, Windows(asked, kept)), laid(photos), rtol=1e-4, atol=1e-5)
    assert len(calls) == 2 * used


def test_a_gradient_of_zero_proves_nothing():
    mean, (linear, [of, weight, bias]) = head(1, 8)
    layers = convolution("x", 3, 8, 2), convolution((0,), 8, 8, 2)
    for scale in (1, 0):
        network = program(*layers, mean, (linear, [of, scale * weight, bias]))
        assert (cuts.find_cut(network, pictures(2)) is not None) == bool(scale)


def test_a_network_too_small_to_save_anything_is_not_cut(monkeypatch):
    photos = pictures(2)
    assert cuts.find_cut(plain(), photos)
    monkeypatch.undo()
    assert cuts.find_cut(plain(), photos) is None
    larger = torch.rand(2, 3, 4 * SIZE, 4 * SIZE)
    assert cuts.find_cut(plain(), larger)


def test_batches_take_their_own_windows(monkeypatch):
    laid, photos = tune_batches(plain(), pictures()), pictures(7)
    monkeypatch.setattr(laid, "max_pictures", 3)
    asked = np.array([[10 * i, 5 * i, 10 * i + 20, 5 * i + 30] for i in range(7)])
    torch.manual_seed(0)
    whole, parts = gradient(laid, photos), gradient(lambda x: laid(x, Windows(asked)), photos)
    for one, same, (left, top, right, bottom) in zip(parts, whole, asked.tolist(), strict=True):
        torch.testing.assert_close(one[:, top:bottom, left:right], same[:, top:bottom, left:right])
    assert not torch.equal(parts, whole)
    monkeypatch.setattr(laid, "size", 3)  # the seventh picture goes three times
    filled = gradient(lambda x: laid(x, Windows(asked)), photos)
    torch.testing.assert_close(filled[6], whole[6])


@pytest.mark.parametrize("photo_px", [(SIZE, SIZE), (SIZE, SIZE + 33), (210, 170), (96, 100)])
def test_photographs_of_any_size_have_windows(photo_px):
    """What is reduced to the square, or enlarged, has its gradient where the photographs' windows lie; one window
    reaches out of the square, one lies outside.
    """
    torch.manual_seed(0)
    laid, (height, width) = tune_batches(plain(), pictures()), photo_px
    classifier = Classifier("plain", None, SIZE, tuple("abcde"), laid)
    asked = np.array([[40, 30, 61, 48], [width - 20, 50, width, 70], [0, 0, 3, height]])
    photos = torch.rand(3, 3, height, width)
    whole = gradient(classifier.logits, photos)
    parts = gradient(lambda x: classifier.logits(x, None, asked), photos)
    for one, same, (left, top, right, bottom) in zip(parts, whole, asked.tolist(), strict=True):
        torch.testing.assert_close(one[:, top:bottom, left:right], same[:, top:bottom, left:right])
    assert not torch.equal(parts, whole)


@pytest.mark.parametrize("photo_px", [(64, 64), (90, 90), (200, 131), (40, 50), (269, 269)])
def test_squares_differ_in_their_windows_only(photo_px):
    """Each window changed by itself, at the sizes where reducing and enlarging reach furthest."""
    height, width = photo_px
    asked = np.array([[width // 2, height // 3, width // 2 + 1, height // 3 + 4], [0, 0, 9, 7], [30, 30, 40, 40]])
    photos = torch.zeros(3, 3, height, width)
    for photo, (left, top, right, bottom) in zip(photos, asked.tolist(), strict=True):
        photo[:, top:bottom, left:right] = 1
    for square, (left, top, right, bottom) in zip(
        center_square(photos, 64), _windows_in_square(asked, photo_px, 64).tolist(), strict=True
    ):
        assert right - left <= 64 * 12 / min(photo_px) + 4
        square[:, top:bottom, left:right] = 0
        assert not square.any()


@pytest.mark.parametrize("made", [plain, residual, joined])
@pytest.mark.parametrize("seed", range(4))
def test_pictures_that_differ_in_windows_share_the_rest(made, seed):
    """Wherever cut, for windows of any place and size; in batches, each of its own first pictures."""
    torch.manual_seed(seed)
    network, rng = made(), np.random.default_rng(seed)
    starts, sides = rng.integers(0, SIZE - 40, (4, 2)), rng.integers(0, 40, (4, 2))
    starts[0] = [(0, 0), (SIZE - 40, 0), (0, SIZE - 40), (SIZE - 40, SIZE - 40)][seed]
    sides[0] = 40  # up to the rim
    asked, first = np.hstack([starts, starts + sides]), pictures(4)
    others = [first.clone(memory_format=torch.channels_last) for _ in range(2)]
    for other in others:
        for picture, (left, top, right, bottom) in zip(other, asked.tolist(), strict=True):
            picture[:, top:bottom, left:right] = torch.rand(3, bottom - top, right - left)
    with torch.no_grad():
        for cut in cuts._cuts(network, first[:2]):
            kept = {}
            for photos in (first, *others):
                told = cut.answers(photos, Windows(asked, kept))
                torch.testing.assert_close(told, network(photos), rtol=1e-4, atol=1e-5)
            assert torch.equal(kept[cut], network.first(cut.steps, first)[cut.value]), "steps write over their own"


def test_batches_keep_their_own_first_pictures(monkeypatch):
    laid, first = tune_batches(plain(), pictures()), pictures(7)
    monkeypatch.setattr(laid, "max_pictures", 3)
    asked = np.array([[10 * i, 5 * i, 10 * i + 20, 5 * i + 30] for i in range(7)])
    other = first.clone()
    for picture, (left, top, right, bottom) in zip(other, asked.tolist(), strict=True):
        picture[:, top:bottom, left:right] = 0
    elsewhere = torch.rand_like(first)
    with torch.no_grad():
        kept = {}
        for photos in (first, other):
            torch.testing.assert_close(laid(photos, Windows(asked, kept)), laid(photos), rtol=1e-4, atol=1e-5)
        assert not torch.allclose(laid(elsewhere, Windows(asked, kept)), laid(elsewhere)), "what is kept is used"


def test_nothing_is_sought_before_it_is_asked_for(monkeypatch):
    asked = []
    monkeypatch.setattr(cuts, "find_cut", lambda *_: asked.append(1))
    laid = tune_batches(plain(), pictures())
    laid(pictures())
    assert not asked
    for _ in range(2):
        laid(pictures(), Windows(np.array([[0, 0, 9, 9]] * 3)))
    assert asked == [1]


@pytest.mark.parametrize("jobs", [1, 2])
def test_training_asks_in_windows_and_finds_the_same_design(tmp_path, monkeypatch, jobs):
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
    torch.manual_seed(0)
    network = classifier_of(plain(), 192, ["red", *"bcde"])
    camera = {"camera__noise": [0.0, 0.0], "camera__blur_px": [0.0, 2.0], "view__distance_mm": [700, 900]}
    camera |= {"background__color": [0.5, 0.5, 0.5]}
    scene = scene_with(tmp_path, optimize__steps=2, target__models=["python:network"], **camera)
    problem = replace(set_problem(scene, models=[network]), jobs=jobs)
    asked = asked_of(problem.classifiers[0].network, monkeypatch)
    designs = [best_design(problem)]
    assert asked or jobs > 1  # other processes count for themselves
    monkeypatch.setattr("patchproof.optimizer.expectation.affected_windows", lambda views: None)
    designs.append(best_design(problem))
    assert len(np.unique(designs[0])) > 10 and np.abs(designs[0].astype(int) - designs[1]).max() <= 1


def test_a_promise_shares_what_its_views_have_in_common(tmp_path, monkeypatch):
    """The design and its controls are told apart as well as if each had been seen wholly, the bare object among them,
    also where some views show the back of an overhanging piece.
    """
    torch.manual_seed(0)
    network = classifier_of(plain(), SIZE, ["red", *"bcde"])
    scene = scene_with(tmp_path, target__models=["python:network"], view__azimuth_deg=[-170, 170])
    problem = set_problem(scene, models=[network])
    shown = pictures_with_controls(problem, np.full((*problem.patch.design_px[::-1], 3), 200, np.uint8), CONTROLS)
    conditions, calls = scene.draw("promise", 8), asked_of(problem.classifiers[0].network, monkeypatch)
    shared = responses(problem, shown, conditions)
    assert len(calls) == 2 * len(shown) and all(windows.cache for _, _, windows in calls)
    monkeypatch.setattr("patchproof.optimizer.responses.affected_windows", lambda views: None)
    whole = responses(problem, shown, conditions)
    for kind in shown:
        np.testing.assert_allclose(shared[kind].confidence, whole[kind].confidence, atol=1e-6)
        assert (shared[kind].confidence != shared["bare"].confidence).any() or kind == "bare"


@pytest.mark.parametrize("made", [ResNet, ConvNeXt, lambda: load_builtin().network, Written])
def test_modules_in_memory_are_cut_where_torch_can_follow_them(made):
    network = seeded(made()).eval().requires_grad_(False)
    side = 96
    photos, asked = torch.rand(3, 3, side, side), np.array([[40, 30, 50, 44], [0, 0, 9, 9], [80, 85, 96, 96]])
    laid = tune_batches(network, photos)
    assert laid.cut is not None
    whole, parts = gradient(laid, photos), gradient(lambda x: laid(x, Windows(asked)), photos)
    for one, same, (left, top, right, bottom) in zip(parts, whole, asked.tolist(), strict=True):
        torch.testing.assert_close(one[:, top:bottom, left:right], same[:, top:bottom, left:right])
    assert not torch.equal(parts, whole)


@pytest.mark.parametrize("made", [ViT, Turns, Counts, Masked, Slices])
def test_modules_that_torch_cannot_follow_are_computed_whole(made):
    network = made().eval().requires_grad_(False)
    photos, asked = torch.rand(3, 3, 16, 16), np.array([[4, 4, 6, 6]] * 3)
    laid = tune_batches(network, photos)
    assert laid.cut is None
    assert torch.isfinite(gradient(lambda x: laid(x, Windows(asked)), photos)).all()


def test_a_file_s_steps_are_weighed_on_rectangles_too():
    """A program whose values are small for whole pictures, and absurd for those of other sizes."""
    places = program(
        (ATEN.sym_size.int, ["x", 3]),
        (lambda size: (SIZE - size) * 10**9 + 1, [(0,)]),
        (ATEN.new_zeros.default, ["x", [(1,)]]),
        (ATEN.sum.default, [(2,)]),
        convolution("x", 3, 8, 2),
        (ATEN.add.Tensor, [(4,), (3,)]),
        convolution((5,), 8, 8, 2),
        *head(6, 8),
    )
    photos = pictures()
    assert places(photos).shape == (3, 5)
    with pytest.raises(ValueError, match="absurd size"):
        places.first(6, photos[..., :64, :64])
    laid, asked = tune_batches(places, photos), np.array([[50, 50, 60, 60]] * 3)
    torch.testing.assert_close(gradient(lambda x: laid(x, Windows(asked)), photos), gradient(places, photos))


@pytest.mark.skipif(torch.__version__ < "2.13", reason="torch 2.6 imports its compiler for any gradient")
def test_files_and_gradients_need_no_compiler_of_torch_s(tmp_path):
    """Torch imports it, and SymPy, for tensors without memory and for a gradient to begin with: two seconds of every
    command. What loads a network of common operators has nothing from onnx either.
    """
    onnx_files = pytest.importorskip("onnx_files", reason='needs onnx, of the extra "test"')
    body = "a = Sub(x, [0.5]) b = Conv(a, W, F) c = Clip(b, Zero, Two) y = ReduceMean<keepdims=0>(c, [2, 3])"
    file = onnx_files.save(tmp_path, onnx_files.model(body))
    scene = toml(tmp_path / "scene.toml", target__models=["builtin"], target__label="carton", camera__photo_px=[96, 96])
    code = f"""
import sys
from pathlib import Path
from patchproof.classifier import load_classifier
load_classifier("file:{file}", Path("."))
unwanted = {{"torch._dynamo", "sympy", "onnx"}}
assert not unwanted & sys.modules.keys(), "imported by a file"
import numpy as np, torch
import patchproof as pp
from patchproof.networks import batches
from patchproof.optimizer import loop
from patchproof.optimizer.problem import set_problem
from patchproof.optimizer.promise import CONTROLS, pictures_with_controls
from patchproof.optimizer.responses import responses
problem = set_problem(pp.load_scene({str(scene)!r}))
batches.CUT_COST = 0  # the network is small
network, photos = problem.classifiers[0].network, torch.rand(2, 3, 96, 96).requires_grad_()
network(photos, batches.Windows(np.array([[40, 40, 50, 50]] * 2))).sum().backward()
assert network.cut and not photos.grad[..., 0].any()
next(loop.steps(problem))
assert not unwanted & sys.modules.keys(), "imported by a gradient"
"""
    subprocess.run([sys.executable, "-c", code], check=True)
