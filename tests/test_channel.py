"""Light and camera: laws, and what is left of blur and noise in a smaller picture."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from patchproof.channel.camera import blurred, compressed, develop, noisy
from patchproof.channel.light import Light, irradiance
from patchproof.color import linear_from_srgb
from patchproof.scene.conditions import draw
from patchproof.settings import SceneSettings, validated


def conditions(n, **camera):
    quiet = {"exposure_ev": [0, 0], "white_balance": 0, "blur_px": [0, 0], "noise": [0, 0], "jpeg": [95, 95]}
    settings = {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 9, "height_mm": 9},
        "target": {"label": 0, "models": ["builtin"]},
        "camera": quiet | camera,
    }
    return draw(validated(SceneSettings, settings, "test"), "promise", n, 0)


def test_paper_facing_the_light_is_white_and_facing_away_gets_the_ambient_part():
    normal = torch.tensor([[0.0, 0, 1], [0, 0, -1], [1, 0, 0]])
    lamp = Light(torch.tensor([0.4]), torch.tensor([0.6]), torch.tensor([[0.0, 0, 1]]))
    light = irradiance(normal, torch.tensor([0, 0, 0]), lamp)
    torch.testing.assert_close(light, torch.tensor([1.0, 0.4, 0.4]))


def test_a_perfect_camera_only_encodes():
    linear = torch.rand(2, 3, 8, 8)
    torch.testing.assert_close(linear_from_srgb(develop(linear, conditions(2), 0.4)), linear, atol=1e-5, rtol=0)


def test_one_stop_doubles_the_light_and_what_is_too_much_is_clipped():
    drawn = conditions(1, exposure_ev=[1, 1])
    linear = torch.tensor([0.1, 0.3, 0.7]).view(1, 1, 1, 3).expand(1, 3, 1, 3)
    torch.testing.assert_close(
        linear_from_srgb(develop(linear, drawn, 0.1))[0, 0, 0], torch.tensor([0.2, 0.6, 1.0]), atol=1e-5, rtol=0
    )


def test_white_balance_keeps_green_and_moves_red_and_blue():
    drawn = conditions(4, white_balance=0.1)
    seen = linear_from_srgb(develop(torch.full((4, 3, 2, 2), 0.2), drawn, 0.1))[:, :, 0, 0] / 0.2
    np.testing.assert_allclose(seen.numpy(), drawn.white_balance, rtol=1e-4)
    assert np.abs(drawn.white_balance[:, [0, 2]] - 1).max() > 0.02


@pytest.mark.parametrize("sigma", [0.8, 1.5])
def test_blur_spreads_a_point_by_its_sigma_and_keeps_its_light(sigma):
    point = torch.zeros(1, 1, 31, 31)
    point[0, 0, 15, 15] = 1
    spread = blurred(point, torch.tensor([sigma]))[0, 0]
    x = torch.arange(31.0) - 15
    assert float(spread.sum()) == pytest.approx(1, abs=1e-4)
    assert float((spread.sum(0) * x**2).sum()) ** 0.5 == pytest.approx(sigma, rel=0.03)


def test_blur_too_small_to_be_seen_costs_nothing():
    picture = torch.rand(2, 3, 9, 9)
    assert blurred(picture, torch.tensor([0.0, 0.3])) is picture


def test_noise_has_the_stated_variance_and_is_each_views_own():
    flat = torch.full((2, 3, 200, 200), 0.5)
    seen = noisy(flat, torch.tensor([0.02, 0.02]), [5, 6])
    expected = 0.02 * (0.5 + 0.25**2) ** 0.5
    assert float((seen - flat).std()) == pytest.approx(expected, rel=0.02)
    assert not torch.equal(seen[0], seen[1])
    assert torch.equal(noisy(flat[:1], torch.tensor([0.02]), [6])[0], seen[1])


def test_noise_shrinks_with_the_picture_as_averaging_shrinks_it():
    drawn = conditions(1, noise=[0.04, 0.04])
    full = develop(torch.full((1, 3, 240, 240), 0.3), drawn, 1.0, jpeg=False)
    averaged = torch.nn.functional.avg_pool2d(linear_from_srgb(full), 3)
    small = linear_from_srgb(develop(torch.full((1, 3, 80, 80), 0.3), drawn, 1 / 3))
    assert float(small.std()) == pytest.approx(float(averaged.std()), rel=0.05)


def test_jpeg_is_near_a_real_encoder_and_carries_gradients():
    """Quality 75 on a smooth picture against Pillow's own, both against the original."""
    from io import BytesIO

    from PIL import Image

    y, x = torch.meshgrid(torch.arange(50.0), torch.arange(70.0), indexing="ij")
    picture = torch.stack([torch.sin(x / 5), torch.cos(y / 6), torch.sin((x + y) / 7)])[None] / 2.2 + 0.5
    ours = compressed(picture.requires_grad_(), torch.tensor([75.0]))
    assert ours.shape == picture.shape
    (gradient,) = torch.autograd.grad(ours.sum(), picture)
    assert bool((gradient != 0).any())
    buffer = BytesIO()
    Image.fromarray((picture[0].detach().permute(1, 2, 0).numpy() * 255).round().astype("uint8")).save(
        buffer, "JPEG", quality=75
    )
    theirs = torch.tensor(np.asarray(Image.open(buffer))).permute(2, 0, 1)[None] / 255
    assert float((ours.detach() - theirs).abs().mean()) < 0.012


def test_develop_matches_finite_differences():
    drawn = conditions(1, exposure_ev=[-0.3, -0.3], white_balance=0.05, blur_px=[2, 2])
    linear = (torch.rand(1, 3, 6, 6, dtype=torch.float64) * 0.8 + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: develop(x, drawn, 0.4), linear, atol=1e-6)
