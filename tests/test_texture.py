"""Textures: what is looked up, and where the gradient goes."""

from __future__ import annotations

import pytest
import torch

from patchproof.render.texture import footprint, layout, look_up, texel_table


def look(texture, uv, dx, dy, wrap=False, taps=4):
    size = (texture.shape[1], texture.shape[0])
    n = len(uv)
    seen = footprint(layout([size], wrap), torch.zeros(n, dtype=torch.long), uv, dx.expand(n, 2), dy.expand(n, 2), taps)
    return look_up(seen, texel_table([texture]))


def centers(width, height):
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], 1)


def per_pixel(width, height):
    return torch.tensor([[1 / width, 0.0]]), torch.tensor([[0.0, 1 / height]])


def test_a_texture_seen_texel_by_texel_is_itself():
    texture = torch.rand(6, 9, 3)
    seen = look(texture, centers(9, 6), *per_pixel(9, 6), taps=1)
    torch.testing.assert_close(seen.view(6, 9, 3), texture)


def test_wrap_repeats_and_clamp_goes_on():
    texture = torch.rand(8, 8, 3)
    uv = centers(8, 8)
    torch.testing.assert_close(
        look(texture, uv + 3, *per_pixel(8, 8), wrap=True, taps=1), texture.view(-1, 3), atol=2e-5, rtol=0
    )
    beyond = look(texture, uv + torch.tensor([5.0, 0]), *per_pixel(8, 8), taps=1)
    torch.testing.assert_close(beyond.view(8, 8, 3), texture[:, -1:].expand(8, 8, 3))


def test_seen_from_afar_a_texture_is_its_mean():
    texture = torch.rand(64, 64, 3)
    far = torch.tensor([[1.0, 0]]), torch.tensor([[0.0, 1]])
    torch.testing.assert_close(
        look(texture, torch.tensor([[0.3, 0.6]]), *far), texture.mean((0, 1))[None], atol=1e-5, rtol=0
    )


@pytest.mark.parametrize("reduction", [2, 4, 8])
def test_a_reduced_texture_is_near_the_box_average(reduction):
    """A smooth picture reduced by whole numbers against the averages of its blocks."""
    y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
    texture = torch.stack([torch.sin(x / 9), torch.cos(y / 7), torch.sin((x + y) / 11)], -1) / 2 + 0.5
    n = 64 // reduction
    seen = look(texture, centers(n, n), *per_pixel(n, n)).view(n, n, 3)
    blocks = texture.view(n, reduction, n, reduction, 3).mean((1, 3))
    assert (seen - blocks)[1:-1, 1:-1].abs().max() < 0.05


def test_oblique_views_keep_detail_along_the_short_axis():
    """Stripes across the short axis of a 4:1 footprint: one isotropic sample loses them, taps keep them."""
    stripes = (torch.arange(64) // 4 % 2).float()[:, None, None].expand(64, 64, 3)  # vary along v
    uv, dx, dy = centers(8, 32), torch.tensor([[8 / 64, 0.0]]), torch.tensor([[0.0, 2 / 64]])
    contrast = [float(look(stripes, uv, dx, dy, taps=taps).std()) for taps in (1, 4)]
    assert contrast[0] < 0.25 < 0.4 < contrast[1]


def test_the_gradient_is_that_of_finite_differences_and_reaches_seen_texels_only():
    torch.manual_seed(0)
    texture = torch.rand(12, 10, 3, dtype=torch.float64, requires_grad=True)
    uv = torch.rand(30, 2) * torch.tensor([0.4, 0.4])
    dx, dy = torch.tensor([[0.11, 0.02]]), torch.tensor([[-0.03, 0.13]])
    assert torch.autograd.gradcheck(lambda t: look(t, uv, dx, dy), texture, atol=1e-7)
    sharp = look(texture, uv, torch.tensor([[0.01, 0]]), torch.tensor([[0.0, 0.01]])).sum()
    (gradient,) = torch.autograd.grad(sharp, texture)
    touched = gradient.abs().sum(-1) > 0
    assert touched[:6, :5].any() and not touched[7:].any() and not touched[:, 7:].any()


def test_one_texel_and_large_textures():
    one = torch.rand(1, 1, 3)
    torch.testing.assert_close(look(one, torch.rand(5, 2), *per_pixel(4, 4)), one.view(1, 3).expand(5, 3))
    large = torch.full((8192, 16, 3), 0.25)
    seen = look(large, torch.rand(5, 2), torch.tensor([[1e-3, 0]]), torch.tensor([[0.0, 1e-3]]))
    torch.testing.assert_close(seen, torch.full((5, 3), 0.25))


def test_several_textures_of_different_sizes_do_not_mix():
    textures = [torch.full((4, 4, 3), 0.1), torch.full((32, 16, 3), 0.5), torch.full((1, 1, 3), 0.9)]
    where = layout([(4, 4), (16, 32), (1, 1)], wrap=True)
    texture = torch.tensor([0, 1, 2]).repeat(20)
    derivative = torch.rand(60, 2, generator=torch.Generator().manual_seed(1)) * 0.6
    seen = look_up(
        footprint(where, texture, torch.rand(60, 2) * 9 - 4, derivative, derivative.flip(1)), texel_table(textures)
    )
    expected = torch.tensor([0.1, 0.5, 0.9])[texture][:, None].expand(60, 3)
    torch.testing.assert_close(seen, expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [64, 63, 65, 57])
def test_a_pattern_stays_in_its_place_at_every_mip_level(size):
    """The light-weighted middle of a soft spot, seen at 1 to 8 texels per pixel: within 0.06 pixels of where it is."""
    x = torch.arange(size) + 0.5
    for middle in (0.2 * size, 0.5 * size, 0.8 * size):
        spot = torch.exp(-(((x - middle) / 5) ** 2))
        texture = (spot[:, None] * spot[None]).unsqueeze(-1).expand(size, size, 3)
        for pixels in (size, size // 2, size // 4, size // 8):
            seen = look(texture, centers(pixels, pixels), *per_pixel(pixels, pixels))[:, 0].view(pixels, pixels)
            at = (torch.arange(pixels) + 0.5) * size / pixels
            assert float((seen.sum(0) * at).sum() / seen.sum()) == pytest.approx(middle, abs=0.06 * size / pixels)
