"""Color conversions: sRGB ↔ linear light ↔ CIELAB, and the color difference CIEDE2000.

In and out: numpy arrays or torch tensors with the channels in the *last* axis (`... × 3`), or of any shape where a
function works per value. `*_srgb` is display-encoded in [0, 1], `*_linear` is light relative to sRGB white. CIELAB is
D65, 2°. Training and report share one formula, whichever library they use.

Sources: IEC 61966-2-1 (sRGB); CIE 15:2004 (CIELAB); Sharma, Wu, Dalal, Color Res. Appl. 30 (2005) 21-30 (CIEDE2000).
"""

import math
import sys
from typing import Any, TypeVar

import numpy as np

ArrayOrTensor = TypeVar("ArrayOrTensor")  # a function returns the kind that it was given
LUMINANCE = (0.2126390, 0.7151687, 0.0721923)  # Y of sRGB's linear primaries, D65
_XYZ_FROM_LINEAR = ((0.4123908, 0.3575843, 0.1804808), LUMINANCE, (0.0193308, 0.1191948, 0.9505322))
_WHITE_D65 = (0.9504559, 1.0, 1.0890578)  # the matrix's own row sums, so that sRGB white is exactly L* 100, a* b* 0
MAX_TONE = 0.24  # from 0.25 on a tone curve is not monotonic


def linear_from_srgb(srgb: ArrayOrTensor) -> ArrayOrTensor:
    """Convert sRGB to linear light, per value; odd-symmetric about 0, so it has an inverse and a derivative there."""
    xp = _library(srgb)
    size = xp.abs(srgb)
    # the maximum keeps the unused branch of `where` from giving NaN gradients
    curved = ((_at_least(xp, size, 0.04045) + 0.055) / 1.055) ** 2.4
    return _sign(xp, srgb) * xp.where(size <= 0.04045, size / 12.92, curved)


def srgb_from_linear(linear: ArrayOrTensor) -> ArrayOrTensor:
    """Convert linear light to sRGB, per value; the exact inverse of `linear_from_srgb`."""
    xp = _library(linear)
    size = xp.abs(linear)
    curved = _at_least(xp, size, 0.0031308) ** (1 / 2.4)
    curved *= 1.055
    curved -= 0.055
    if xp is np:  # the same bits, in two thirds of the time
        return xp.copysign(np.minimum(12.92 * size, curved), linear)
    return _sign(xp, linear) * xp.where(size <= 0.0031308, 12.92 * size, curved)


def lift_tone(codes, tone):
    """Return codes in [0, 1] after a phone's tone mapping: code 0.5 rises by `tone` (at most 0.25), 0 and 1 stay."""
    rise = 4 * tone
    return codes * (1 + rise - rise * codes)  # codes + 4·tone·codes·(1 - codes)


def clamp_to_unit(values):
    """Clip to [0, 1] with gradient 1 at 0 and 1, else a fully black or white pixel could never change again; torch's
    own has gradient 0 there since 2.14, which is why older releases are required.
    """
    return values.clip(0, 1)


def codes_from_srgb(srgb):
    """Round sRGB, clipped to [0, 1], to uint8 code values; halves go to even codes."""
    xp = _library(srgb)
    codes = xp.round(xp.clip(srgb, 0, 1) * 255)
    return codes.astype(np.uint8) if xp is np else codes.byte()


def photo_codes_from_srgb(srgb: np.ndarray) -> np.ndarray:
    """Round sRGB, clipped to [0, 1], to the uint8 code values of a photograph; halves go up."""
    return (np.clip(srgb, 0, 1) * 255 + 0.5).astype(np.uint8)


def lab_from_srgb(srgb):
    """Convert `... × 3` sRGB values to CIELAB (D65, L* 0..100)."""
    return lab_from_linear(linear_from_srgb(srgb))


def lab_from_linear(linear):
    """Convert `... × 3` linear sRGB to CIELAB (D65); light below 0 follows CIELAB's straight part."""
    xp = _library(linear)
    r, g, b = linear[..., 0], linear[..., 1], linear[..., 2]
    f = []
    for (kr, kg, kb), white in zip(_XYZ_FROM_LINEAR, _WHITE_D65, strict=True):
        t = (kr * r + kg * g + kb * b) / white
        cubic = _at_least(xp, t, (6 / 29) ** 3) ** (1 / 3)
        f.append(xp.where(t > (6 / 29) ** 3, cubic, t / (3 * (6 / 29) ** 2) + 4 / 29))
    return xp.stack([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])], -1)


def ciede2000(lab_a, lab_b):
    """Return ΔE00 between two `... × 3` CIELAB arrays, by eqs. 2-22 and in the symbols of Sharma et al."""
    xp = _library(lab_a)
    tiny = 1e-12  # inside square roots, so that the gradient is finite (0) where two colors are equal
    L1, a1, b1 = lab_a[..., 0], lab_a[..., 1], lab_a[..., 2]
    L2, a2, b2 = lab_b[..., 0], lab_b[..., 1], lab_b[..., 2]
    C_bar = (xp.sqrt(a1**2 + b1**2 + tiny) + xp.sqrt(a2**2 + b2**2 + tiny)) / 2
    G = 0.5 * (1 - xp.sqrt(C_bar**7 / (C_bar**7 + 25.0**7) + tiny))
    a1p, a2p = (1 + G) * a1, (1 + G) * a2
    C1p, C2p = xp.sqrt(a1p**2 + b1**2 + tiny), xp.sqrt(a2p**2 + b2**2 + tiny)
    h1p, h2p = _hue(xp, b1, a1p), _hue(xp, b2, a2p)
    gray, dh = C1p * C2p < 1e-10, h2p - h1p
    dh = xp.where(dh > math.pi, dh - 2 * math.pi, xp.where(dh < -math.pi, dh + 2 * math.pi, dh))
    dh = xp.where(gray, 0 * dh, dh)
    dL, dC, dH = L2 - L1, C2p - C1p, 2 * xp.sqrt(C1p * C2p + tiny) * xp.sin(dh / 2)
    L_bar, C_barp = (L1 + L2) / 2, (C1p + C2p) / 2
    h_sum = h1p + h2p
    wrapped = xp.where(h_sum < 2 * math.pi, h_sum / 2 + math.pi, h_sum / 2 - math.pi)
    h_bar = xp.where(xp.abs(h1p - h2p) <= math.pi, h_sum / 2, wrapped)
    h_bar = xp.where(gray, h_sum, h_bar)
    T = 1 - 0.17 * xp.cos(h_bar - math.radians(30)) + 0.24 * xp.cos(2 * h_bar)
    T = T + 0.32 * xp.cos(3 * h_bar + math.radians(6)) - 0.20 * xp.cos(4 * h_bar - math.radians(63))
    d_theta = math.radians(30) * xp.exp(-(((h_bar * (180 / math.pi) - 275) / 25) ** 2))
    R_C = 2 * xp.sqrt(C_barp**7 / (C_barp**7 + 25.0**7) + tiny)
    S_L = 1 + 0.015 * (L_bar - 50) ** 2 / xp.sqrt(20 + (L_bar - 50) ** 2)
    S_C, S_H = 1 + 0.045 * C_barp, 1 + 0.015 * C_barp * T
    R_T = -xp.sin(2 * d_theta) * R_C
    light, chroma, hue = dL / S_L, dC / S_C, dH / S_H
    return xp.sqrt(_at_least(xp, light**2 + chroma**2 + hue**2 + R_T * chroma * hue, 0.0) + tiny)


def _hue(xp, b, a):
    """Hue angle in [0, 2π); 0 for gray, where the gradient of arctan2 is NaN in some releases of torch."""
    angle = xp.arctan2(b, a + ((a == 0) & (b == 0)))
    return xp.where(angle < 0, angle + 2 * math.pi, angle)


def _library(array: Any) -> Any:
    """The array's library; torch is looked up and never imported, so that work on photographs needs no torch."""
    return sys.modules["torch"] if type(array).__module__.partition(".")[0] == "torch" else np


def _sign(xp, array):
    return xp.sign(array if xp is np else array.detach())  # torch would compute its gradient, which is 0


def _at_least(xp, array, floor: float):
    return np.maximum(array, floor) if xp is np else array.clamp_min(floor)


LINEAR_FROM_CODE = linear_from_srgb(np.arange(256) / 255)  # linear light by 8-bit code value
