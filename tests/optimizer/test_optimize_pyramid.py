"""Levels of a gradient and their sum: by hand, at edges and under masks, and what they are for."""

import pytest
import torch

from patchproof.optimizer.subject import MIN_COARSEST_BLOCKS, build_pyramid, collapse_pyramid, level_count


@pytest.mark.parametrize(("size", "count"), [((1, 5), 1), ((8, 8), 1), ((15, 40), 1), ((16, 16), 2), ((64, 80), 4)])
def test_the_coarsest_level_has_eight_blocks_or_more(size, count):
    found = build_pyramid(torch.rand(3, *size))
    assert level_count(size) == len(found) == count
    assert min(found[-1].shape[1:]) >= min(MIN_COARSEST_BLOCKS, *size)


def test_levels_are_the_means_of_blocks_also_where_the_edge_cuts_them():
    gradient = torch.arange(17 * 18.0).reshape(1, 17, 18)
    fine, coarse = build_pyramid(gradient)
    assert torch.equal(fine, gradient) and coarse.shape == (1, 9, 9)
    assert coarse[0, 0, 0] == gradient[0, :2, :2].mean() and coarse[0, 8, 1] == gradient[0, 16:, 2:4].mean()


def test_under_a_mask_only_what_may_change_counts():
    mask = torch.zeros(16, 16, dtype=torch.bool)
    mask[0, 0] = mask[4:6, 4:6] = True
    gradient = torch.rand(3, 16, 16) * mask
    _, coarse = build_pyramid(gradient, mask)
    torch.testing.assert_close(coarse[:, 0, 0], gradient[:, 0, 0])
    torch.testing.assert_close(coarse[:, 2, 2], gradient[:, 4:6, 4:6].mean((1, 2)))
    assert (coarse[:, 5:] == 0).all()


def test_levels_add_up_to_one_step_and_the_sum_has_the_design_s_size():
    ones = [torch.ones_like(level) for level in build_pyramid(torch.zeros(3, 33, 40))]
    assert len(ones) == 3
    torch.testing.assert_close(collapse_pyramid(ones), torch.full((3, 33, 40), 3 / 3**0.5))
    alone = torch.rand(3, 5, 5)
    assert torch.equal(collapse_pyramid([alone]), alone)


def test_a_large_shape_in_a_noisy_gradient_is_found_sooner_than_pixel_by_pixel():
    """Signs of 8 noisy gradients of a half-black, half-white picture, as Adam's first steps are."""
    generator = torch.Generator().manual_seed(0)
    truth = torch.ones(1, 64, 64)
    truth[..., :32] = -1
    coarse, fine = torch.zeros_like(truth), torch.zeros_like(truth)
    for _ in range(8):
        gradient = truth + 8 * torch.randn(truth.shape, generator=generator)
        coarse += collapse_pyramid([level.sign() for level in build_pyramid(gradient)])
        fine += gradient.sign()
    assert (coarse.sign() == truth).float().mean() > 0.95 > 0.7 > (fine.sign() == truth).float().mean()
