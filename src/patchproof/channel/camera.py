"""Light on surfaces, and the camera: linear light at the lens becomes a display-encoded picture.

Light is even ambient light and one directional light per view (Lambert), in units in which 1 shows white paper as sRGB
white at exposure 0. All light is white: the camera has the white balance. Left out on purpose: interreflection and cast
shadows (for the default ranges, a ledge 10 mm high along the top of a patch 110 mm wide takes 4 % of its light in the
mean view, 9 % at the 95 % point); a lamp's fall-off, ambient light that differs by direction, and highlights on paper,
which together took 0.5 points [-0.1, 1.0] of promised rates on glossy paper half a meter from a lamp (9 pairs of scene
and network).

Camera. In: N×3×H×W linear light and a `Sensor`. Out: N×3×H×W sRGB in [0, 1], differentiable. Order: blur (optics,
focus, straight motion), exposure and white balance, shot and read noise, clipping, sRGB's curve, the photograph's own
tone. The lens's distortion has its own module.

Blur, motion, noise and JPEG are given for the photograph's full size. A picture of `scale` times that size averages
pixels, so they are multiplied by `scale`, and skipped where invisible. At full size the writer makes a real JPEG.
"""

from functools import lru_cache, partial

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.base.color import clamp_to_unit, lift_tone, srgb_from_linear
from patchproof.channel.effects import Light, Sensor

# A blur below this sigma (pixels) is hidden by a pixel's averaging and by the blur of resampling.
SMALLEST_BLUR_PX = 0.4
SMALLEST_MOTION_PX = SMALLEST_BLUR_PX * 12**0.5  # the length of an even streak of that sigma
# Noise below one 8-bit step moved no rate and no mean confidence by more than 0.001 (40 photographs).
SMALLEST_NOISE = 1 / 255
# Below half size a JPEG block covers less than 4 pixels and averages out.
SMALLEST_JPEG_SCALE = 0.5
# Read noise is this share of the noise at white; shot noise makes up the rest (variance = noise² (x + READ_SHARE²)).
READ_SHARE = 0.25
_TABLE_STEPS = 1 << 18  # of light in `encode_light_by_table`


def develop(linear: Tensor, sensor: Sensor, scale: float, jpeg: bool = True) -> Tensor:
    """Return the pictures that a camera makes of linear light, one row of `sensor` per picture. `scale` is their size
    divided by the photograph's. `jpeg=False` leaves JPEG to the writer of a real file.
    """
    tensor = partial(torch.as_tensor, dtype=linear.dtype, device=linear.device)
    light = gaussian_blur(linear, tensor(sensor.blur_px * scale))
    light = motion_blur(light, tensor(sensor.motion_px * scale), sensor.motion_deg)
    light = light * gains(sensor, linear)[:, :, None, None]
    picture = encode_light(add_noise(light, tensor(sensor.noise * scale), sensor.noise_seed))
    picture = lift_tone(picture, tensor(sensor.tone)[..., None, None])
    return compress_jpeg(picture, tensor(sensor.jpeg)) if _has_jpeg(sensor, scale, jpeg) else picture


def is_pointwise(sensor: Sensor, scale: float, jpeg: bool) -> bool:
    """True if `develop` treats every pixel alone, so that a changed region can be developed without the rest."""
    return reach_px(sensor, scale, jpeg) == 0 and bool((sensor.noise * scale).max() < SMALLEST_NOISE)


def reach_px(sensor: Sensor, scale: float, jpeg: bool = True) -> int | None:
    """Return how many pixels far `develop` spreads light; None if JPEG spreads it within its blocks."""
    if _has_jpeg(sensor, scale, jpeg):
        return None
    return _blur_reach(float(sensor.blur_px.max()) * scale) + _motion_reach(float(sensor.motion_px.max()) * scale)


def _blur_reach(sigma_px: float) -> int:
    return 0 if sigma_px < SMALLEST_BLUR_PX else int(3 * sigma_px + 0.5)


def _motion_reach(length_px: float) -> int:
    return 0 if length_px < SMALLEST_MOTION_PX else int(length_px / 2) + 1


def _has_jpeg(sensor: Sensor, scale: float, jpeg: bool) -> bool:
    return bool(jpeg and scale >= SMALLEST_JPEG_SCALE and sensor.jpeg.any())


def gains(sensor: Sensor, like: Tensor) -> Tensor:
    """Return exposure and white balance as N×3 factors of the light."""
    return torch.as_tensor(2 ** sensor.exposure_ev[:, None] * sensor.white_balance).to(like)


def encode_light(linear: Tensor) -> Tensor:
    """Return clipped light as code values in [0, 1]."""
    return srgb_from_linear(clamp_to_unit(linear))


def encode_light_by_table(linear: Tensor) -> Tensor:
    """Encode light by a table, within 1/100 of an 8-bit step, in a seventh of the time; not differentiable."""
    index = (linear * _TABLE_STEPS).add_(0.5).clamp_(0, _TABLE_STEPS).int()
    return _code_table(linear.device).index_select(0, index.flatten()).view(linear.shape)


@lru_cache(maxsize=4)
def _code_table(device: torch.device) -> Tensor:
    return encode_light(torch.linspace(0, 1, _TABLE_STEPS + 1, dtype=torch.float64, device=device)).float()


def gaussian_blur(linear: Tensor, sigma_px: Tensor) -> Tensor:
    """Blur pictures by Gaussians, one sigma per picture; if all sigmas are too small to be seen, return the input."""
    reach = _blur_reach(float(sigma_px.max()))
    if reach == 0:
        return linear
    taps, sigma = torch.arange(-reach, reach + 1).to(sigma_px), sigma_px.clamp_min(0.05)[:, None]  # 0.05 px: unchanged
    kernels = torch.exp(-taps.square() / (2 * sigma.square()))  # kornia's, whose import takes longer than most blurs
    kernels = kernels / kernels.sum(1, keepdim=True)
    kernels = torch.where(kernels > 1e-30, kernels, 0.0)  # numbers near the smallest took seven times as long
    return _filtered(linear, kernels[:, None], kernels[:, :, None])


def motion_blur(linear: Tensor, length_px: Tensor, angle_deg) -> Tensor:
    """Blur pictures by even, straight motion, with a length and an angle (counter-clockwise from x) for each."""
    if _motion_reach(float(length_px.max())) == 0:
        return linear
    return _filtered(linear, _streaks(length_px, torch.as_tensor(angle_deg).to(linear)))


def _filtered(pictures: Tensor, *kernels: Tensor) -> Tensor:
    """Correlate pictures N×C×H×W with kernels N×h×w of odd sides in turn, edges repeated: the same bits as kornia's
    `filter2d`, in a seventh of its time at 1600 × 1200 px.
    """
    count, channels, *_ = pictures.shape
    below, right = (sum(kernel.shape[axis] // 2 for kernel in kernels) for axis in (1, 2))
    padded = torch.nn.functional.pad(pictures.contiguous(), (right, right, below, below), mode="replicate")
    filtered = padded.flatten(0, 1)[None].contiguous(memory_format=torch.channels_last)
    for kernel in kernels:
        weights = kernel.repeat_interleave(channels, 0)[:, None]
        filtered = torch.nn.functional.conv2d(filtered, weights, groups=count * channels)
    return filtered.reshape(pictures.shape)


def _streaks(length_px: Tensor, angle_deg: Tensor) -> Tensor:
    """Return N×k×k motion kernels of sum 1: points along a line, each shared out bilinearly between four pixels."""
    reach = _motion_reach(float(length_px.max()))
    pixels = torch.arange(-reach, reach + 1).to(length_px)
    steps = 8 * reach  # four or more per pixel
    along = length_px[:, None] * ((torch.arange(steps).to(length_px) + 0.5) / steps - 0.5)
    angle = torch.deg2rad(angle_deg)[:, None]
    x, y = along * torch.cos(angle), -along * torch.sin(angle)  # rows run down
    tent_x, tent_y = ((1 - (pixels - center[..., None]).abs()).clamp_min(0) for center in (x, y))
    return tent_y.mT @ tent_x / steps


def add_noise(linear: Tensor, noise: Tensor, seeds) -> Tensor:
    """Add shot and read noise to linear light (EMVA 1288: variance linear in the signal); one seed per picture."""
    if float(noise.max()) < SMALLEST_NOISE:
        return linear
    # drawn on the CPU for every device, so that a GPU gets the same noise
    generators = (torch.Generator().manual_seed(int(seed)) for seed in seeds)
    grain = torch.stack([torch.randn(linear.shape[1:], generator=generator) for generator in generators]).to(linear)
    return linear + noise[:, None, None, None] * (linear.detach().clamp_min(0) + READ_SHARE**2).sqrt() * grain


def compress_jpeg(picture: Tensor, quality: Tensor) -> Tensor:
    """Apply a differentiable JPEG to sRGB pictures; sizes need not be multiples of 16."""
    from kornia.enhance import jpeg_codec_differentiable

    height, width = picture.shape[-2:]
    padded = torch.nn.functional.pad(picture, (0, -width % 16, 0, -height % 16), mode="replicate")
    return clamp_to_unit(jpeg_codec_differentiable(padded, quality)[..., :height, :width])


def lighting_of(light: Light, forward, up, device: torch.device | str = "cpu") -> Tensor:
    """Return the light of N views on a patch whose printed side faces `forward`, 4×N: the ambient light, and the
    directional light as a vector towards it.
    """
    toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, forward, up)
    values = np.stack([light.ambient, *(light.directional * toward.T)])  # sent to a device at once
    return torch.as_tensor(values.astype(np.float32), device=device)


def irradiance(normal: Tensor, light: Tensor) -> Tensor:
    """Return the light P on fragments with unit `normal` 3×P, in the `light` 4×P of their views (`lighting_of`)."""
    ambient, *directional = light
    return geometry.dot(normal.unbind(), directional).clamp_min_(0).add_(ambient)
