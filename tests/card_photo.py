"""Photographs of a printed page with a bank card on it, ray by ray: a renderer that shares nothing with the package's.

In: the page as an image, a pose, and the card as a thick rounded rectangle with print, side walls and a contact shadow.
Every pixel is the mean of 3×3 rays; light is linear; blur, noise, a tone curve that is not sRGB's and JPEG follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

CARD, THICK, RADIUS = (85.60, 53.98), 0.76, 3.18


@dataclass(frozen=True)
class Card:
    """Middle in true page mm, turn in degrees, seed of its print; `wall` is linear light, None for a floating face."""

    middle: tuple[float, float]
    turn_deg: float = 0.0
    seed: int = 0
    wall: float | None = 0.6
    shadow: float = 0.35
    size: tuple[float, float] = CARD
    white_border: bool = False


def pose(tilt_deg, toward_deg, distance_mm, roll_deg, look_mm):
    """(rotation 3×3, eye) of a camera above page mm (x right, y down, z into the paper) that looks at `look_mm`."""
    tilt, toward, roll = np.radians([tilt_deg, toward_deg, roll_deg])
    away = np.array([np.sin(tilt) * np.cos(toward), np.sin(tilt) * np.sin(toward), -np.cos(tilt)])
    eye = np.array([*look_mm, 0.0]) + distance_mm * away
    z = -away
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z]), eye


def photo(page_linear, px_per_mm, scale, card, rotation, eye, focal_px, size_px, **look):
    """uint8 sRGB; `page_linear` H×W×3 is the intended page, printed `scale` times its size."""
    width, height = size_px
    fine = look.get("fine", 3)
    total = np.zeros((height, width, 3), np.float32)
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    for i in range(fine):
        for j in range(fine):
            rays = (
                np.stack(
                    [
                        (u + (i + 0.5) / fine - width / 2) / focal_px,
                        (v + (j + 0.5) / fine - height / 2) / focal_px,
                        np.ones_like(u, float),
                    ],
                    -1,
                )
                @ rotation
            )
            total += _shade(page_linear, px_per_mm, scale, card, eye, rays)
    linear = total / fine**2 * np.float32(look.get("light", 0.75))
    if look.get("blur", 0) > 0:
        linear = cv2.GaussianBlur(linear, (0, 0), look["blur"])
    linear = linear + np.random.default_rng(look.get("seed", 0)).normal(0, 1, linear.shape) * look.get("noise", 0)
    codes = np.clip(linear, 0, 1) ** (1 / look.get("gamma", 2.2))
    srgb = np.clip(codes * 255 + 0.5, 0, 255).astype(np.uint8)
    if look.get("jpeg"):
        code = cv2.imencode(".jpg", srgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, look["jpeg"]])[1]
        srgb = np.ascontiguousarray(cv2.imdecode(code, cv2.IMREAD_COLOR)[..., ::-1])
    return srgb


def _shade(page, px_per_mm, scale, card, eye, rays):
    ground = eye + rays * (-eye[2] / rays[..., 2])[..., None]
    mm = (ground[..., :2] / scale).astype(np.float32)
    light = cv2.remap(
        page,
        mm[..., 0] * px_per_mm - 0.5,
        mm[..., 1] * px_per_mm - 0.5,
        cv2.INTER_LINEAR,
        None,
        cv2.BORDER_CONSTANT,
        (0.08, 0.06, 0.05),
    )
    if card is None:
        return light
    top = eye + rays * ((-THICK - eye[2]) / rays[..., 2])[..., None]
    on_face, face_at = _inside(card, top[..., :2])
    on_base, base_at = _inside(card, ground[..., :2])
    near = np.maximum(_distance(card, base_at - np.array([0.3, 0.4])), 0)
    light = light * (1 - card.shadow * np.exp(-near / 0.8))[..., None]
    if card.wall is not None:
        light = np.where(on_base[..., None], np.float32(card.wall), light)
    return np.where(on_face[..., None], _print(card, face_at), light).astype(np.float32)


def _distance(card, at):
    """Signed distance in mm to the rounded rectangle, negative inside."""
    q = np.abs(at) - np.array(card.size) / 2 + RADIUS
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(-1), 0) - RADIUS


def _inside(card, xy):
    c, s = np.cos(np.radians(card.turn_deg)), np.sin(np.radians(card.turn_deg))
    at = (xy - np.array(card.middle)) @ np.array([[c, -s], [s, c]])
    return _distance(card, at) < 0, at


def _print(card, at):
    """A card's print: a slanted two-color ground, a stripe or a picture, a chip, lines of raised digits."""
    rng = np.random.default_rng(card.seed)
    a, b = rng.uniform(0.02, 0.75, (2, 3))
    share = 0.5 + 0.5 * np.tanh((at @ rng.normal(0, 0.05, 2)) + 0.4 * np.sin(at[..., :1].squeeze(-1) / 9))
    light = a + (b - a) * share[..., None]
    x, y = at[..., 0], at[..., 1]
    if card.seed % 3 == 1:
        light = np.where(((y > -20) & (y < -8))[..., None], 0.02, light)  # magnetic stripe
    chip = (np.abs(x + 26) < 6) & (np.abs(y + 1) < 5)
    light = np.where(chip[..., None], [0.55, 0.4, 0.12], light)
    digits = (np.abs(y - 8) < 2) & (np.sin(x * 2.1) > 0.2) & (np.abs(x) < 34)
    light = np.where(digits[..., None], 0.8, light)
    if card.seed % 3 == 2:  # a printed frame
        frame = np.abs(_distance(card, at) + 3) < 0.5
        light = np.where(frame[..., None], 0.7, light)
    if card.white_border:
        light = np.where((_distance(card, at) > -2)[..., None], 0.85, light)
    return light
