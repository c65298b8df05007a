"""Atlases: what is seen in them is what footprints see, to rounding, wherever textures lie."""

from __future__ import annotations

import pytest
import torch

from patchproof.render.surfaces import MAX_TAPS, atlas_layout, atlas_table, sample_atlas
from patchproof.render.texture import footprint, look_up, texel_layout, texel_table

# Places in an atlas are float32 shares of its sides: of 1,100 texels a ten-thousandth of one.
PLACED = 2e-4
SIZES = ((64, 48), (1, 1), (300, 7), (350, 23), (33, 33))


def textures(sizes=SIZES):
    generator = torch.Generator().manual_seed(0)
    return [torch.rand(height, width, 3, generator=generator) for width, height in sizes]


def fragments(n=4000):
    """Of every texture, from a hundredth of a texel to many textures to a pixel, some of them far from square."""
    generator = torch.Generator().manual_seed(1)
    uv, dx, dy = (torch.randn(n, 2, generator=generator) * scale for scale in (3, 1, 1))
    scales = (10 ** (5 * torch.rand(n, 1, generator=generator) - 4) for _ in range(2))
    dx, dy = (step * scale for step, scale in zip((dx, dy), scales, strict=True))
    return torch.randint(len(SIZES), (n,), generator=generator), uv, dx, dy


@pytest.mark.parametrize("taps", [1, 2, 3, MAX_TAPS])
def test_what_is_seen_in_an_atlas_is_what_footprints_see(taps):
    own, at = textures(), fragments()
    where = atlas_layout(SIZES)
    seen = sample_atlas(where, atlas_table(own, where), *at, taps)
    told = look_up(footprint(texel_layout(list(SIZES), wrap=True), *at, taps), texel_table(own))
    torch.testing.assert_close(seen, told, atol=PLACED, rtol=0)


def test_no_texture_is_seen_in_another():
    colors = torch.rand(len(SIZES), 3, generator=torch.Generator().manual_seed(2))
    own = [color.expand(height, width, 3) for color, (width, height) in zip(colors, SIZES, strict=True)]
    where, (texture, *at) = atlas_layout(SIZES), fragments(20_000)
    seen = sample_atlas(where, atlas_table(own, where), texture, *at, MAX_TAPS)
    torch.testing.assert_close(seen, colors[texture], atol=1e-6, rtol=0)


def test_each_fragment_sees_to_the_bit_what_it_would_alone():
    where, at = atlas_layout(SIZES), fragments(600)
    table = atlas_table(textures(), where)
    whole = sample_atlas(where, table, *at, 3)
    for size in (1, 7, 50):
        parts = [sample_atlas(where, table, *(v[k : k + size] for v in at), 3) for k in range(0, 600, size)]
        assert torch.equal(torch.cat(parts), whole)
    assert sample_atlas(where, table, *(v[:0] for v in at), 3).shape == (0, 3)


@pytest.mark.parametrize(
    ("sizes", "most"),
    [([(1024, 1024), *[(1, 1)] * 200, *[(64, 64)] * 40], 2.2), ([(64, 1024), (512, 64)] * 6, 6)],
)
def test_shelves_waste_little_where_textures_are_of_many_sizes(sizes, most):
    """Beside tables without margins; narrow textures have most of them."""
    own, where = [torch.zeros(height, width, 3) for width, height in sizes], atlas_layout(sizes)
    assert len(atlas_table(own, where)) < most * len(texel_table(own))
