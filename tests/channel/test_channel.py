"""The camera: laws, and what is left of blur, motion and noise in a smaller picture."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kornia.filters import filter2d, gaussian_blur2d
from tolerances import BY_TABLE, CODE

from patchproof.base.color import MAX_TONE, lift_tone, linear_from_srgb
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.channel.camera import (
    _streaks,
    add_noise,
    compress_jpeg,
    develop,
    encode_light,
    encode_light_by_table,
    gains,
    gaussian_blur,
    is_pointwise,
    motion_blur,
)
from patchproof.channel.effects import tone_by_channel
from patchproof.scene.conditions import draw


def sensor(n, **camera):
    quiet = {
        "exposure_ev": [0, 0],
        "white_balance": 0,
        "blur_px": [0, 0],
        "noise": [0, 0],
        "jpeg": [95, 95],
        "tone": [0, 0],
    }
    settings = {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 9, "height_mm": 9},
        "target": {"label": 0, "models": ["builtin"]},
        "camera": quiet | camera,
    }
    return draw(validate_model(SceneSettings, settings, "test"), "promise", n, 0).sensor


def test_codes_by_table_are_those_of_the_curve():
    light = torch.cat([torch.linspace(-0.5, 1.5, 100_001), 2.0 ** torch.linspace(-30, 0, 10_001)]).double()[:, None]
    quick = encode_light_by_table(light.float().expand(-1, 3))
    off = (quick.double() - encode_light(light)).abs()
    assert quick.shape == (len(light), 3) and float(off.max()) < BY_TABLE < CODE / 70


def test_a_perfect_camera_only_encodes():
    linear = torch.rand(2, 3, 8, 8)
    torch.testing.assert_close(linear_from_srgb(develop(linear, sensor(2), 0.4)), linear, atol=1e-5, rtol=0)


def test_one_stop_doubles_the_light_and_what_is_too_much_is_clipped():
    drawn = sensor(1, exposure_ev=[1, 1])
    linear = torch.tensor([0.1, 0.3, 0.7]).view(1, 1, 1, 3).expand(1, 3, 1, 3)
    torch.testing.assert_close(
        linear_from_srgb(develop(linear, drawn, 0.1))[0, 0, 0], torch.tensor([0.2, 0.6, 1.0]), atol=1e-5, rtol=0
    )


def test_white_balance_keeps_green_and_moves_red_and_blue():
    drawn = sensor(4, white_balance=0.1)
    seen = linear_from_srgb(develop(torch.full((4, 3, 2, 2), 0.2), drawn, 0.1))[:, :, 0, 0] / 0.2
    np.testing.assert_allclose(seen.numpy(), drawn.white_balance, rtol=1e-4)
    assert np.abs(drawn.white_balance[:, [0, 2]] - 1).max() > 0.02


@pytest.mark.parametrize("sigma", [0.8, 1.5])
def test_blur_spreads_a_point_by_its_sigma_and_keeps_its_light(sigma):
    point = torch.zeros(1, 1, 31, 31)
    point[0, 0, 15, 15] = 1
    spread = gaussian_blur(point, torch.tensor([sigma]))[0, 0]
    x = torch.arange(31.0) - 15
    assert float(spread.sum()) == pytest.approx(1, abs=1e-4)
    assert float((spread.sum(0) * x**2).sum()) ** 0.5 == pytest.approx(sigma, rel=0.03)


def test_blur_too_small_to_be_seen_costs_nothing():
    picture = torch.rand(2, 3, 9, 9)
    assert gaussian_blur(picture, torch.tensor([0.0, 0.3])) is picture


@pytest.mark.parametrize("length, angle", [(6.0, 0.0), (6.0, 90.0), (7.0, 30.0), (3.0, 135.0)])
def test_motion_spreads_a_point_along_its_line_only_and_keeps_its_light(length, angle):
    point = torch.zeros(1, 1, 31, 31, dtype=torch.float64)
    point[0, 0, 15, 15] = 1
    streak = motion_blur(point, torch.tensor([length], dtype=torch.float64), [angle])[0, 0]
    x = torch.arange(31.0, dtype=torch.float64) - 15
    assert float(streak.sum()) == pytest.approx(1, abs=1e-9)
    moments = torch.stack([(streak.sum(0) * x * x).sum(), (streak.sum(1) * x * x).sum()])
    mixed = -(streak * x * x[:, None]).sum()  # counter-clockwise is up, rows run down
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    # an even line has variance L²/12; sharing points between pixels adds up to 1/6 (0 across where they lie on rows)
    along = moments[0] * cos**2 + 2 * mixed * cos * sin + moments[1] * sin**2
    across = moments[0] * sin**2 - 2 * mixed * cos * sin + moments[1] * cos**2
    assert length**2 / 12 < float(along) + 1e-2 and float(along) < length**2 / 12 + 0.26
    assert float(across) < 0.26 and (angle % 90 or float(across) < 1e-9)
    torch.testing.assert_close(streak, streak.flip(0, 1))


def test_motion_is_the_mean_of_shifted_pictures():
    """A slow twin for a whole number of pixels: a line of 4 px, of which the ends count half."""
    picture = torch.rand(1, 3, 20, 20, dtype=torch.float64)
    seen = motion_blur(picture, torch.tensor([4.0], dtype=torch.float64), [0.0])[..., 4:-4]
    weights = {-2: 1, -1: 2, 0: 2, 1: 2, 2: 1}
    true = sum(w / 8 * picture.roll(shift, -1) for shift, w in weights.items())[..., 4:-4]
    torch.testing.assert_close(seen, true, atol=0.01, rtol=0)


def test_motion_is_each_pictures_own_and_too_short_a_one_costs_nothing():
    pictures = torch.rand(3, 3, 24, 24)
    lengths, angles = torch.tensor([0.0, 3.0, 9.0]), [10.0, 20.0, 30.0]
    together = motion_blur(pictures, lengths, angles)
    torch.testing.assert_close(together[0], pictures[0])
    for i in (1, 2):
        alone = motion_blur(pictures[i : i + 1], lengths[i : i + 1], angles[i : i + 1])[0]
        torch.testing.assert_close(together[i], alone, atol=0.01, rtol=0)  # the line is cut into other steps
    assert motion_blur(pictures, torch.tensor([0.0, 1.0, 1.3]), angles) is pictures


def test_only_what_treats_pixels_alone_is_pointwise():
    def pointwise(**camera):
        return is_pointwise(sensor(3, **camera), 1.0, False)

    assert pointwise() and pointwise(exposure_ev=[-1, 1], white_balance=0.1, motion_px=[0, 1])
    for term in ({"motion_px": [4, 4]}, {"blur_px": [2, 2]}, {"noise": [0.05, 0.05]}):
        assert not pointwise(**term), term


def test_terms_that_are_off_change_no_bit():
    linear = torch.rand(3, 3, 16, 16)
    drawn = sensor(3, exposure_ev=[-0.5, 0.5], blur_px=[0, 2], noise=[0, 0.02])
    spread = gaussian_blur(linear, torch.as_tensor(drawn.blur_px).float())
    assert motion_blur(linear, torch.zeros(3), [0.0] * 3) is linear
    exposed = add_noise(
        spread * gains(drawn, linear)[:, :, None, None], torch.as_tensor(drawn.noise).float(), drawn.noise_seed
    )
    assert torch.equal(develop(linear, drawn, 1.0, jpeg=False), encode_light(exposed))


def test_noise_has_the_stated_variance_and_is_each_views_own():
    flat = torch.full((2, 3, 200, 200), 0.5)
    seen = add_noise(flat, torch.tensor([0.02, 0.02]), [5, 6])
    expected = 0.02 * (0.5 + 0.25**2) ** 0.5
    assert float((seen - flat).std()) == pytest.approx(expected, rel=0.02)
    assert not torch.equal(seen[0], seen[1])
    assert torch.equal(add_noise(flat[:1], torch.tensor([0.02]), [6])[0], seen[1])


def test_noise_shrinks_with_the_picture_as_averaging_shrinks_it():
    drawn = sensor(1, noise=[0.04, 0.04])
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
    ours = compress_jpeg(picture.requires_grad_(), torch.tensor([75.0]))
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
    drawn = sensor(1, exposure_ev=[-0.3, -0.3], white_balance=0.05, blur_px=[2, 2], motion_px=[8, 8])
    linear = (torch.rand(1, 3, 6, 6, dtype=torch.float64) * 0.8 + 0.1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: develop(x, drawn, 0.4), linear, atol=1e-6)


@pytest.mark.parametrize("colors_side_by_side", [False, True])
@pytest.mark.parametrize("shape", [(1, 3, 60, 81), (4, 3, 40, 40), (3, 1, 33, 20)])
def test_blur_and_motion_are_kornias_to_the_bit(shape, colors_side_by_side):
    photos = torch.rand(shape)
    if colors_side_by_side:
        photos = photos.contiguous(memory_format=torch.channels_last)
    sigmas, lengths, angles = (torch.linspace(*ends, len(photos)) for ends in ((0.02, 2), (1.5, 6), (0, 70)))
    size, sigmas_yx = 2 * int(3 * float(sigmas.max()) + 0.5) + 1, sigmas.clamp_min(0.05)[:, None].expand(-1, 2)
    theirs = gaussian_blur2d(photos, (size, size), sigmas_yx, border_type="replicate")
    assert torch.equal(gaussian_blur(photos, sigmas), theirs)
    assert torch.equal(
        motion_blur(photos, lengths, angles), filter2d(photos, _streaks(lengths, angles), border_type="replicate")
    )


def test_channels_have_tones_of_their_own_in_each_session_that_stay_monotonic():
    tones = draw(SceneSettings.model_construct(), "promise", 400, 0, per_session=4).sensor.tone
    mean = tones.mean(1)
    apart = (tones - mean[:, None]).reshape(100, 4, 3)
    assert np.abs(apart - apart[:, :1]).max() < 1e-12 and 0.03 < np.abs(apart).max() < 0.04
    assert np.abs(mean).max() < 0.06 and np.ptp(mean.reshape(100, 4), axis=1).min() > 0  # each photograph's own
    widest = tone_by_channel(np.array([MAX_TONE]), *MAX_TONE * np.array([[1], [-1], [-1]]))
    assert (np.diff(lift_tone(np.linspace(0, 1, 256)[:, None], widest), axis=0) > 0).all()
    assert (tone_by_channel(*np.zeros((4, 1))) == 0).all()
