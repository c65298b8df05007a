"""Light on surfaces: ambient, even or not, one directional light and one lamp per view; paper may be glossy.

In: per-view light and, per fragment, its unit normal and where it lies. Out: irradiance per fragment, in units in which
1 shows white paper as sRGB white at exposure 0, and what glossy paper adds on top. All light is white: the camera has
the white balance. A term that is off in all views is None, and nothing is computed for it.

Left out on purpose: cast shadows and interreflection; an object's own shadow on the patch is not predicted. What that
costs, computed for the default ranges: a ledge 10 mm high along the top of a patch 110 mm wide shades 28 % of it in the
mean view and takes 4 % of its light (9 % at the 95 % point); a card 5 mm off its object darkens a strip of the object 9
mm wide by a third where the light comes from 60 degrees, and nothing on itself.

Sources: Lambert; Ramamoorthi and Hanrahan, An Efficient Representation for Irradiance Environment Maps, SIGGRAPH 2001,
eq. 13; Blinn, Models of Light Reflection for Computer Synthesized Pictures, SIGGRAPH 1977, normalized exactly for light
along the normal as in Giesen, Phong and Blinn-Phong Normalization Factors, 2009.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.channel.effects import Light

# Irradiance per unit of the coefficients L1-1 L10 L11 L2-2 L2-1 L20 L21 L22 (eq. 13).
_C1, _C2, _C3, _C5 = 0.429043, 0.511664, 0.743125, 0.247708
# Mean square of irradiance over directions and over coefficients of unit variance: A1²·3/4π + A2²·5/4π with
# A1 = 2π/3, A2 = π/4. Dividing by its root makes `sh2` the standard deviation of the ambient light, as a share of it.
_SPREAD = (np.pi / 3 + 5 * np.pi / 64) ** 0.5
PAPER_REFLECTANCE = 0.85  # of white paper, whose light is 1: what a highlight takes, the print under it loses
_NEAREST_MM = 1.0  # nearer to a lamp, light no longer grows


@dataclass(frozen=True)
class Lamp:
    """A lamp per view: `irradiance` N it would give `distance_mm` N away, and where it stands, N×3."""

    irradiance: Tensor
    distance_mm: Tensor
    position_mm: Tensor


@dataclass(frozen=True)
class Gloss:
    """The paper's surface per view: the `share` N of the light that it reflects as a highlight, and its exponent N."""

    share: Tensor
    shininess: Tensor


@dataclass(frozen=True)
class Lighting:
    """The light of N views: `ambient` and `directional` N, the unit directions `toward` the light N×3, and what is not
    on in every scene; `uneven` N×8 is the part of the ambient light that depends on direction.
    """

    ambient: Tensor
    directional: Tensor
    toward: Tensor
    uneven: Tensor | None = None
    lamp: Lamp | None = None
    gloss: Gloss | None = None


def lighting_of(light: Light, forward, up, middle_mm, device: torch.device | str = "cpu") -> Lighting:
    """The light of N views on a patch whose side faces `forward`, with its middle at `middle_mm`."""

    def on(values) -> Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.float32, device=device)

    uneven = lamp = gloss = None
    toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, forward, up)
    if light.sh2.any():
        uneven = on((light.ambient * light.sh2)[:, None] * light.sh2_coefficients)
    if light.point.any():
        away = geometry.orbit(light.point_azimuth_deg, light.point_elevation_deg, forward, up)
        position = np.asarray(middle_mm) + light.point_distance_mm[:, None] * away
        lamp = Lamp(on(light.point), on(light.point_distance_mm), on(position))
    if light.gloss.any():
        gloss = Gloss(on(light.gloss), on(light.shininess))
    return Lighting(on(light.ambient), on(light.directional), on(toward), uneven, lamp, gloss)


def irradiance(normal: Tensor, view: Tensor, light: Lighting, position_mm: Tensor | None = None) -> Tensor:
    """Light on P fragments with unit `normal` P×3, each in one of the views (`view` P).

    `position_mm` P×3 is needed where there is a lamp only. Uneven ambient light that would be negative is 0: at `sh2`
    0.3 that happens in 0.04 % of directions, at 1 in 16 %, where it makes the mean 8 % lighter.
    """
    ambient = light.ambient.index_select(0, view)
    if light.uneven is not None:
        for value, coefficients in zip(irradiance_basis(normal), light.uneven.T.contiguous(), strict=True):
            ambient = ambient.addcmul_(value, coefficients.index_select(0, view))
        ambient = ambient.clamp_min_(0)
    cosine = _cosines(normal, light.toward.index_select(0, view))
    total = ambient + light.directional.index_select(0, view) * cosine
    if light.lamp is not None:
        strength, toward = _from_lamp(light.lamp, view, position_mm)
        total = total + strength * _cosines(normal, toward)
    return total


def _cosines(a: Tensor, b: Tensor) -> Tensor:
    """P cosines, 0 from behind, of unit vectors P×3; over three columns, torch's own sum takes half as long again."""
    return geometry.dot(a.unbind(-1), b.unbind(-1)).clamp_min(0)


def highlight(
    normal: Tensor, position_mm: Tensor | None, eye_mm: Tensor, view: Tensor, light: Lighting
) -> Tensor | None:
    """White light P that glossy paper adds to what is printed, as seen from `eye_mm` N×3; None where nothing is glossy.

    Blinn-Phong with h halfway between light l and eye: share · (s + 2)(s + 4) / (8 (s + 2^(-s/2))) · (n·h)^s · (n·l),
    so that of light along the normal the share is reflected whatever the shininess s. The even part of the ambient
    light is seen mirrored, too: a veil of share · ambient.
    """
    if light.gloss is None:
        return None
    if position_mm is None:
        raise ValueError("highlights need positions")
    share, shininess = light.gloss.share.index_select(0, view), light.gloss.shininess
    peak = (shininess + 2) * (shininess + 4) / (8 * (shininess + 2 ** (-shininess / 2)))
    toward_eye = torch.nn.functional.normalize(eye_mm.index_select(0, view) - position_mm, dim=-1)

    def lobe(toward: Tensor) -> Tensor:
        half = torch.nn.functional.normalize(toward + toward_eye, dim=-1)
        mirrored = _cosines(normal, half) ** shininess.index_select(0, view)
        return peak.index_select(0, view) * mirrored * _cosines(normal, toward)

    sun = light.directional.index_select(0, view) * lobe(light.toward.index_select(0, view))
    total = light.ambient.index_select(0, view) + sun
    if light.lamp is not None:
        strength, toward = _from_lamp(light.lamp, view, position_mm)
        total = total + strength * lobe(toward)
    return share * total


def _from_lamp(lamp: Lamp, view: Tensor, position_mm: Tensor | None) -> tuple[Tensor, Tensor]:
    """Irradiance P of a surface that faces the lamp, and the unit directions P×3 to it."""
    if position_mm is None:
        raise ValueError("light from a lamp needs positions")
    away = lamp.position_mm.index_select(0, view) - position_mm
    square = (away * away).sum(-1).clamp_min(_NEAREST_MM**2)
    power = (lamp.irradiance * lamp.distance_mm**2).index_select(0, view)
    return power / square, away * square.rsqrt()[:, None]


def irradiance_basis(normal: Tensor) -> list[Tensor]:
    """What each of 8 coefficients of unit variance adds to the irradiance of normals ...×3, in all of variance 1."""
    x, y, z = (axis.contiguous() for axis in normal.unbind(-1))
    linear, product = 2 * _C2 / _SPREAD, 2 * _C1 / _SPREAD
    first = [linear * y, linear * z, linear * x]
    second = [product * x * y, product * y * z, _C3 / _SPREAD * z * z - _C5 / _SPREAD, product * x * z]
    return [*first, *second, product / 2 * (x * x - y * y)]
