"""Color maths: inverses, published pairs, an independent oracle, and the same formula in numpy and torch."""

import numpy as np
import pytest
import torch

from patchproof.base.color import (
    LUMINANCE,
    ciede2000,
    clamp_to_unit,
    codes_from_srgb,
    lab_from_linear,
    lab_from_srgb,
    linear_from_srgb,
    photo_codes_from_srgb,
    srgb_from_linear,
)

# Sharma, Wu, Dalal 2005, Table 1: hue wrap, the 180° jump, grays, small and large differences
SHARMA = [
    ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425),
    ((50, 3.1571, -77.2803), (50, 0, -82.7485), 2.8615),
    ((50, 2.8361, -74.0200), (50, 0, -82.7485), 3.4412),
    ((50, -1.3802, -84.2814), (50, 0, -82.7485), 1.0000),
    ((50, 0, 0), (50, -1, 2), 2.3669),
    ((50, 2.49, -0.001), (50, -2.49, 0.0009), 7.1792),
    ((50, 2.49, -0.001), (50, -2.49, 0.0011), 7.2195),
    ((50, 2.5, 0), (50, 0, -2.5), 4.3065),
    ((50, 2.5, 0), (73, 25, -18), 27.1492),
    ((50, 2.5, 0), (50, 3.1736, 0.5854), 1.0000),
    ((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387), 1.2644),
    ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373),
    ((90.8027, -2.0831, 1.4410), (91.1528, -1.6435, 0.0447), 1.4441),
    ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
]


def random_lab(n=3000, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform([0, -100, -100], [100, 100, 100], (n, 3))


@pytest.mark.parametrize("a, b, expected", SHARMA)
def test_published_differences(a, b, expected):
    for first, second in ((a, b), (b, a)):
        assert ciede2000(np.array(first, float), np.array(second, float)) == pytest.approx(expected, abs=5e-5)


def test_difference_agrees_with_an_independent_oracle():
    colour = pytest.importorskip("colour", reason="colour-science is not installed")
    a, b = random_lab(seed=1), random_lab(seed=2)
    np.testing.assert_allclose(ciede2000(a, b), colour.difference.delta_E_CIE2000(a, b), atol=1e-5)


def test_lab_agrees_with_an_independent_oracle():
    colour = pytest.importorskip("colour", reason="colour-science is not installed")
    srgb = np.random.default_rng(3).random((2000, 3))
    space = colour.RGB_COLOURSPACES["sRGB"]
    xyz = colour.RGB_to_XYZ(srgb, space, apply_cctf_decoding=True)
    expected = colour.XYZ_to_Lab(xyz, space.whitepoint)
    np.testing.assert_allclose(lab_from_srgb(srgb), expected, atol=0.03)  # its matrix is rounded to four digits


def test_transfer_is_its_own_inverse_and_has_the_standard_points():
    values = np.linspace(-1.5, 2.5, 4001)
    np.testing.assert_allclose(linear_from_srgb(srgb_from_linear(values)), values, atol=1e-12)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=2e-6)  # the standard's own gap
    assert linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx([0, 0.0031308, 0.2140411, 1], abs=1e-7)
    np.testing.assert_allclose(linear_from_srgb(-values), -linear_from_srgb(values))
    assert np.all(np.diff(linear_from_srgb(values)) > 0)


def test_white_gray_and_black():
    lab = lab_from_srgb(np.array([[1.0, 1, 1], [0.5, 0.5, 0.5], [0, 0, 0]]))
    np.testing.assert_allclose(lab, [[100, 0, 0], [53.389, 0, 0], [0, 0, 0]], atol=1e-3)
    assert sum(LUMINANCE) == pytest.approx(1, abs=1e-6)
    red = lab_from_srgb(np.array([1.0, 0, 0]))
    np.testing.assert_allclose(red, [53.24, 80.09, 67.20], atol=0.02)


def test_lab_of_light_above_white_and_below_black_is_finite_and_ordered():
    light = np.linspace(-0.1, 3, 200)[:, None] * np.ones(3)
    assert np.all(np.diff(lab_from_linear(light)[:, 0]) > 0)


def test_difference_is_a_symmetric_distance_from_zero():
    a, b = random_lab(seed=4), random_lab(seed=5)
    np.testing.assert_allclose(ciede2000(a, b), ciede2000(b, a), atol=1e-9)
    assert ciede2000(a, a).max() < 1e-5 and np.all(ciede2000(a, b) > 0)


def test_shapes_pass_through_and_broadcast():
    a = random_lab(24).reshape(2, 3, 4, 3)
    assert ciede2000(a, a[0, 0, 0]).shape == (2, 3, 4) and lab_from_srgb(a).shape == a.shape


def test_numpy_and_torch_are_one_formula():
    srgb = np.random.default_rng(6).random((500, 3)) * 1.4 - 0.2
    a, b = random_lab(seed=7), random_lab(seed=8)
    for function, inputs in (
        (linear_from_srgb, [srgb]),
        (srgb_from_linear, [srgb]),
        (lab_from_srgb, [srgb]),
        (lab_from_linear, [srgb]),
        (ciede2000, [a, b]),
    ):
        seen = function(*(torch.tensor(x) for x in inputs)).numpy()
        np.testing.assert_allclose(seen, function(*inputs), atol=1e-10)


def test_gradients_are_true():
    srgb = torch.tensor([[0.2, 0.5, 0.9], [0.7, 0.1, 0.3]], dtype=torch.float64, requires_grad=True)
    other = torch.tensor([[0.3, 0.4, 0.8], [0.6, 0.3, 0.2]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: ciede2000(lab_from_srgb(x), lab_from_srgb(other)), (srgb,))
    assert torch.autograd.gradcheck(lambda x: srgb_from_linear(x), (srgb,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("value", [0.0, 0.04045, 0.5, 1.0])
def test_gradients_are_finite_where_two_colors_are_equal_gray_or_black(dtype, value):
    srgb = torch.full((4, 3), value, dtype=dtype, requires_grad=True)
    (ciede2000(lab_from_srgb(srgb), lab_from_srgb(srgb.detach())).sum() + srgb_from_linear(srgb).sum()).backward()
    assert torch.isfinite(srgb.grad).all()


def test_single_precision_is_good_enough():
    srgb = np.random.default_rng(9).random((2, 2000, 3))
    exact = ciede2000(*lab_from_srgb(srgb))
    single = ciede2000(*lab_from_srgb(torch.tensor(srgb, dtype=torch.float32))).numpy()
    np.testing.assert_allclose(single, exact, atol=2e-3)


def test_codes_are_the_nearest_and_the_two_ways_differ_in_halves_alone():
    halves = np.array([-1.0, 0.5 / 255, 1.5 / 255, 126.5 / 255, 254.5 / 255, 2.0])
    assert codes_from_srgb(halves).tolist() == [0, 0, 2, 126, 254, 255]
    assert photo_codes_from_srgb(halves).tolist() == [0, 1, 2, 127, 255, 255]
    values = np.random.default_rng(0).random((64, 64, 3))
    assert np.array_equal(codes_from_srgb(values), photo_codes_from_srgb(values))
    assert np.array_equal(codes_from_srgb(torch.tensor(values)).numpy(), codes_from_srgb(values))
    every = np.arange(256)
    assert np.array_equal(codes_from_srgb(every / 255), every) and np.array_equal(
        photo_codes_from_srgb(every / 255), every
    )


@pytest.mark.parametrize("kind", [torch.float16, torch.float32, torch.float64])
def test_clamped_values_have_a_gradient_at_black_and_white(kind):
    values = torch.tensor([-0.1, 0.0, 0.3, 1.0, 1.1], dtype=kind, requires_grad=True)
    clipped = clamp_to_unit(values)
    assert clipped.dtype == kind and torch.equal(clipped, torch.tensor([0, 0, 0.3, 1, 1], dtype=kind))
    clipped.sum().backward()
    assert values.grad is not None and values.grad.tolist() == [0, 1, 1, 1, 0]  # torch's own: 0 at both ends since 2.14
    assert clamp_to_unit(np.array([-0.1, 0.5, 1.1])).tolist() == [0, 0.5, 1]
