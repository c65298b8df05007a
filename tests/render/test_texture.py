"""Textures: what is looked up, and where the gradient goes."""

from __future__ import annotations

import math
import time

import pytest
import torch
from tolerances import FLOAT32

from patchproof.render import texture as texture_module
from patchproof.render.pixels import PHOTO_SAMPLING
from patchproof.render.texture import footprint, look_up, texel_layout, texel_table


def look(texture, uv, dx, dy, wrap=False, taps=4, blocks=False):
    return look_up(seen_at(texture, uv, dx, dy, wrap, taps, blocks), texel_table([texture]))


def seen_at(texture, uv, dx, dy, wrap=False, taps=4, blocks=False):
    where, n = texel_layout([(texture.shape[1], texture.shape[0])], wrap), len(uv)
    return footprint(where, torch.zeros(n, dtype=torch.long), uv, dx.expand(n, 2), dy.expand(n, 2), taps, blocks=blocks)


def centers(width, height):
    y, x = torch.meshgrid((torch.arange(height) + 0.5) / height, (torch.arange(width) + 0.5) / width, indexing="ij")
    return torch.stack([x.flatten(), y.flatten()], 1)


def per_pixel(width, height):
    return torch.tensor([[1 / width, 0.0]]), torch.tensor([[0.0, 1 / height]])


@pytest.mark.parametrize("wrap", [False, True])
def test_footprints_found_part_by_part_are_those_found_at_once(monkeypatch, wrap):
    draw = torch.Generator().manual_seed(0)
    uv, dx, dy = (scale * torch.rand(40, 2, generator=draw) for scale in (1, 0.3, 0.3))
    whole = seen_at(torch.rand(20, 30, 3), uv, dx, dy, wrap)
    monkeypatch.setattr(texture_module, "CHUNK", 7)
    parts = seen_at(torch.rand(20, 30, 3), uv, dx, dy, wrap)
    assert all(torch.equal(getattr(whole, name), getattr(parts, name)) for name in ("texel", "weight", "first"))


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


@pytest.mark.parametrize("blocks", [False, True])
def test_seen_from_afar_a_texture_is_its_mean(blocks):
    """Where it repeats, from anywhere; else where it fills the pixel."""
    texture = torch.rand(64, 64, 3)
    far = torch.tensor([[1.0, 0]]), torch.tensor([[0.0, 1]])
    for place, wrap in (((0.3, 0.6), True), ((0.5, 0.5), False)):
        seen = look(texture, torch.tensor([place]), *far, wrap, blocks=blocks)
        torch.testing.assert_close(seen, texture.mean((0, 1))[None], atol=1e-5, rtol=0)


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("taps", [1, 4, 8])
def test_a_constant_texture_is_that_constant_at_any_footprint(taps, blocks):
    generator = torch.Generator().manual_seed(0)
    uv, dx, dy = (torch.randn(400, 2, generator=generator) for _ in range(3))
    scale = 10 ** (4 * torch.rand(400, 1, generator=generator) - 3)
    texture = torch.tensor([0.2, 0.5, 0.9]).expand(37, 22, 3)
    for wrap in (True, False):
        seen = look(texture, uv, dx * scale, dy * scale, wrap, taps, blocks)
        torch.testing.assert_close(seen, texture[0, 0].expand(400, 3), atol=FLOAT32, rtol=0)


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("reduction", [2, 4, 8, 16])
def test_a_texture_reduced_texel_on_texel_is_the_mean_of_its_blocks(reduction, blocks):
    """Any picture: 2 and 4 by taps at texels' centers, more by mip levels too."""
    texture = torch.rand(64, 64, 3)
    n = 64 // reduction
    seen = look(texture, centers(n, n), *per_pixel(n, n), taps=4, blocks=blocks).view(n, n, 3)
    torch.testing.assert_close(seen, texture.view(n, reduction, n, reduction, 3).mean((1, 3)), atol=2e-6, rtol=0)


@pytest.mark.parametrize("size", [(0.3, 0.3), (1, 1), (1.7, 2.6), (5.3, 7.9)])
def test_blocks_are_averaged_exactly_where_the_pixel_is_upright(size):
    """Areas by hand: how much of each column and row a pixel of `size` texels covers."""
    generator = torch.Generator().manual_seed(1)
    texture, middle = torch.rand(20, 30, 3, generator=generator), 9 + torch.rand(50, 2, generator=generator)
    shares = []
    for axis, count in ((0, 30), (1, 20)):
        low, high = (middle[:, axis, None] + sign * size[axis] / 2 for sign in (-1, 1))
        edge = torch.arange(count)
        shares.append((torch.minimum(high, edge + 1) - torch.maximum(low, edge)).clamp_min(0) / size[axis])
    expected = torch.einsum("px,py,yxc->pc", *shares, texture)
    per = torch.tensor([[size[0] / 30, 0.0]]), torch.tensor([[0.0, size[1] / 20]])
    seen = look(texture, middle / torch.tensor([30, 20]), *per, taps=PHOTO_SAMPLING.piece_taps, blocks=True)
    torch.testing.assert_close(seen, expected, atol=1e-5, rtol=0)


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
    """Stripes across the short axis of an 8:1 footprint: one isotropic sample loses them, taps keep them."""
    stripes = (torch.arange(64) // 4 % 2).float()[:, None, None].expand(64, 64, 3)  # vary along v
    uv, dx, dy = centers(4, 32), torch.tensor([[16 / 64, 0.0]]), torch.tensor([[0.0, 2 / 64]])
    contrast = [float(look(stripes, uv, dx, dy, taps=taps).std()) for taps in (1, 4)]
    assert contrast[0] < 0.25 < 0.4 < contrast[1]


def test_the_gradient_is_that_of_finite_differences_and_reaches_seen_texels_only():
    torch.manual_seed(0)
    texture = torch.rand(8, 6, 3, dtype=torch.float64, requires_grad=True)
    uv = torch.rand(20, 2) * torch.tensor([0.4, 0.4])
    dx, dy = torch.tensor([[0.11, 0.02]]), torch.tensor([[-0.03, 0.13]])
    assert torch.autograd.gradcheck(lambda t: look(t, uv, dx, dy), texture, atol=1e-7)
    sharp = look(texture, uv, torch.tensor([[0.01, 0]]), torch.tensor([[0.0, 0.01]])).sum()
    (gradient,) = torch.autograd.grad(sharp, texture)
    touched = gradient.abs().sum(-1) > 0
    assert touched[:4, :3].any() and not touched[5:].any() and not touched[:, 4:].any()


def test_one_texel_and_large_textures():
    one = torch.rand(1, 1, 3)
    torch.testing.assert_close(look(one, torch.rand(5, 2), *per_pixel(4, 4)), one.view(1, 3).expand(5, 3))
    large = torch.full((8192, 16, 3), 0.25)
    seen = look(large, torch.rand(5, 2), torch.tensor([[1e-3, 0]]), torch.tensor([[0.0, 1e-3]]))
    torch.testing.assert_close(seen, torch.full((5, 3), 0.25))


def test_several_textures_of_different_sizes_do_not_mix():
    textures = [torch.full((4, 4, 3), 0.1), torch.full((32, 16, 3), 0.5), torch.full((1, 1, 3), 0.9)]
    where = texel_layout([(4, 4), (16, 32), (1, 1)], wrap=True)
    texture = torch.tensor([0, 1, 2]).repeat(20)
    derivative = torch.rand(60, 2, generator=torch.Generator().manual_seed(1)) * 0.6
    seen = footprint(where, texture, torch.rand(60, 2) * 9 - 4, derivative, derivative.flip(1), 4)
    seen = look_up(seen, texel_table(textures))
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


def points(texture, uv):
    """Between texels' centers, repeated: a bilinear look-up by hand."""
    height, width, _ = texture.shape
    place = uv * torch.tensor([width, height]) - 0.5
    low, share = place.floor().long(), (place - place.floor())[..., None]
    (x0, y0), (x1, y1) = (low % torch.tensor([width, height])).T, ((low + 1) % torch.tensor([width, height])).T
    x, y = share[:, 0], share[:, 1]
    return (1 - y) * ((1 - x) * texture[y0, x0] + x * texture[y0, x1]) + y * (
        (1 - x) * texture[y1, x0] + x * texture[y1, x1]
    )


def blocks(texture, uv):
    """The texel that one is in, repeated."""
    size = torch.tensor([texture.shape[1], texture.shape[0]])
    x, y = ((uv * size).floor().long() % size).T
    return texture[y, x]


def loss_db(one, other):
    return -10 * math.log10(float(((one - other) ** 2).mean()))


def pictures(side=64):
    """Noise in every texel, and a smooth picture; both repeat."""
    v, u = torch.meshgrid(*(torch.arange(side) / side,) * 2, indexing="ij")
    waves = [0.5 + 0.5 * torch.sin(2 * math.pi * (a * u + b * v)) for a, b in ((1, 2), (3, 1), (2, -2))]
    return torch.rand(side, side, 3, generator=torch.Generator().manual_seed(0)), torch.stack(waves, -1)


@pytest.mark.parametrize("tilt_deg", [0, 60, 75])
@pytest.mark.parametrize("scale", [0.1, 0.3, 0.7, 1, 1.9, 3.7, 5, 8, 12])
def test_a_footprint_is_the_mean_of_16_by_16_samples(scale, tilt_deg):
    """At `scale` texels per pixel, tilted and turned. Between points, taps a texel apart miss most at one texel per
    pixel: noise in every texel, the worst of pictures, has 26 dB there. Beyond 16 texels mip levels take over, whose
    boxes blur what repeats every 20 texels.
    """
    uv, turn = torch.rand(300, 2, generator=torch.Generator().manual_seed(2)), 0.4
    dx = torch.tensor([[math.cos(turn), math.sin(turn)]]) * scale / 64
    dy = torch.tensor([[-math.sin(turn), math.cos(turn)]]) * scale / 64 / math.cos(math.radians(tilt_deg))
    steps = (torch.arange(16) + 0.5) / 16 - 0.5
    samples = torch.cat([uv + a * dx + b * dy for a in steps for b in steps])
    longest = scale / math.cos(math.radians(tilt_deg))
    for sampled, as_blocks in ((points, False), (blocks, True)):
        for texture, least in zip(pictures(), (33, 45 if longest <= 16 else 37), strict=True):
            if not as_blocks and least == 33 and 0.5 < scale <= 1:
                least = 25
            seen = look(texture, uv, dx, dy, wrap=True, taps=PHOTO_SAMPLING.piece_taps, blocks=as_blocks)
            assert loss_db(seen, sampled(texture, samples).view(256, 300, 3).mean(0)) > least


def test_the_gradient_reaches_each_texel_that_was_seen_and_no_other():
    """One bilinear footprint across the border: the four texels round it, on the far side where the texture repeats."""
    texture = torch.rand(8, 6, 3, requires_grad=True)
    near, far = per_pixel(60, 80)
    for wrap, expected in ((True, {(0, 0), (0, 5), (7, 0), (7, 5)}), (False, {(0, 0)})):
        (gradient,) = torch.autograd.grad(look(texture, torch.tensor([[0.01, 0.01]]), near, far, wrap).sum(), texture)
        assert {tuple(at) for at in gradient.abs().sum(-1).nonzero().tolist()} == expected
        assert float(gradient.sum()) == pytest.approx(3)
    # the last texel passes on what its copies beyond the border have seen
    (gradient,) = torch.autograd.grad(look(texture, torch.tensor([[1.2, 1.2]]), near, far).sum(), texture)
    assert float(gradient[-1, -1].sum()) == pytest.approx(3)


@pytest.mark.parametrize("scale", [0.4, 1.5, 6])
def test_a_repeated_texture_has_no_seam(scale):
    """Noise rolled by half its size, seen half a texture on: the border lies elsewhere and does not show."""
    texture = torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(3))
    rolled = texture.roll((16, 24), (0, 1))
    uv = torch.stack([torch.linspace(-0.1, 0.1, 41), torch.linspace(0.97, 1.03, 41)], 1)
    per = torch.tensor([[scale / 48, 0.003]]), torch.tensor([[0.002, scale / 32]])
    for as_blocks in (False, True):
        one = look(texture, uv, *per, wrap=True, taps=8, blocks=as_blocks)
        torch.testing.assert_close(
            look(rolled, uv + 0.5, *per, wrap=True, taps=8, blocks=as_blocks), one, atol=1e-4, rtol=0
        )


def test_tables_of_large_textures_take_seconds():
    """2048² in 0.2 s and 0.4 GB; 4096², the largest that meshes keep, 0.6 s and 1.3 GB (one core)."""
    texture = torch.zeros(2048, 2048, 3)
    start = time.perf_counter()
    table = texel_table([texture])
    assert time.perf_counter() - start < 3
    assert len(table) == sum(max(2048 >> k, 1) ** 2 for k in range(12))
