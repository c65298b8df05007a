"""Procedural places to photograph an object in, for users without pictures of real ones: rooms, yards, roads and
tables.

In: a place's number. Out: P×P×3 uint8, always the same for a number. A camera stands on a floor before walls or under a
sky, among boxes that have no class of their own; surfaces have the textures of `patterns`, light falls unevenly and
distant things are blurred. Every other place is one of the flat backgrounds of `patterns`, with details of other kinds.
"""

import numpy as np

from patchproof.base.color import codes_from_srgb
from patchproof.scene.patterns import background, color, draw_texture

PLACE_PX = 256
_SEED = 20
_TEXTURE_PX = 128
_COLOR_SHARE = 0.6  # of a texture's color that remains: walls and floors are grayish
_SKY_DISTANCE = 1e6  # in units of the camera's height above the floor


def procedural_place(number: int) -> np.ndarray:
    """Return the place of a number, P×P×3 uint8."""
    rng = np.random.default_rng([_SEED, number])
    return background(rng, PLACE_PX) if number % 2 else _room(rng, PLACE_PX)


def _room(rng: np.random.Generator, px: int) -> np.ndarray:
    """Render the view of a pinhole camera that stands one unit above a floor."""
    import cv2

    ray = _rays(rng, px)
    depth = np.full(ray.shape[1], _SKY_DISTANCE, np.float32)
    picture = (_paint(rng) * (1.2 - 0.5 * np.clip(ray[1, :, None], 0, 1))).astype(np.float32)
    planes = [(1, -1.0)]  # the floor, then walls: (axis, where it stands)
    if rng.random() < 0.7:
        planes += [(2, rng.uniform(1.5, 6)), (0, -rng.uniform(1.2, 6)), (0, rng.uniform(1.2, 6))]
    all_rays, slope = np.arange(ray.shape[1]), np.where(np.abs(ray) < 1e-9, np.float32(1e-9), ray)
    ahead = ray[:2] / slope[2]
    for axis, position in planes:
        _draw_plane(rng, picture, depth, ray, all_rays, position / slope[axis], axis)
    for _ in range(int(rng.integers(2, 12))):
        _draw_box(rng, picture, depth, ray, slope, ahead)
    light = rng.normal(size=3).astype(np.float32) * rng.uniform(0, 0.35) / 3
    lit = 1 + np.ascontiguousarray(np.clip(ray * np.minimum(depth, 5), -5, 5).T) @ light
    picture *= np.clip(lit, 0.25, 1.8)[:, None]
    picture = np.clip(picture, 0, 1).reshape(px, px, 3)
    return codes_from_srgb(cv2.GaussianBlur(picture, (0, 0), float(rng.choice([0.5, 0.8, 1.2, 2.5]))))


def _paint(rng: np.random.Generator) -> np.ndarray:
    """Return a grayish color, from nearly black to white."""
    strong, gray = color(rng), rng.uniform(0.08, 1)
    return np.clip(gray * (1 + _COLOR_SHARE * (strong - strong.mean())), 0, 1)


def _rays(rng: np.random.Generator, px: int) -> np.ndarray:
    """Return 3×P² directions by rows: x right, y up, z ahead, of a camera that looks down or up a little."""
    half, pitch, roll = np.tan(np.radians(rng.uniform(20, 35))), *np.radians(rng.normal(0, (12, 2)))
    y, x = (0.5 - (np.mgrid[:px, :px].reshape(2, -1) + 0.5) / px) * 2 * half
    x, y = -x * np.cos(roll) - y * np.sin(roll), -x * np.sin(roll) + y * np.cos(roll)
    rays = np.stack([x, y * np.cos(pitch) + np.sin(pitch), np.cos(pitch) - y * np.sin(pitch)])
    return rays.astype(np.float32)


def _draw_plane(rng, picture, depth, ray, rays, distance, axis) -> None:
    """Draw a surface square to an axis, at `distance` along the `rays` (indices), in front of farther things."""
    paint, textured = _paint(rng), rng.random() < 0.7
    make = draw_texture(rng, _TEXTURE_PX) if textured else lambda: np.ones((1, 1, 3))
    fineness = np.exp(rng.uniform(-1.5, 0.7))
    visible = (distance > 0) & (distance < depth[rays])
    if not visible.any():
        return
    rays, distance, texture = rays[visible], distance[visible], make()
    if textured:
        texture = texture.mean(2, keepdims=True) * (1 - _COLOR_SHARE) + texture * _COLOR_SHARE
    texels = ((0.3 + 0.7 * texture) * paint).astype(np.float32).reshape(-1, 3)
    sides = (np.abs(ray[side, rays] * distance) for side in range(3) if side != axis)
    row, column = ((across * len(texture) * fineness).astype(np.int64) % len(texture) for across in sides)
    picture[rays] = texels[row * len(texture) + column]
    depth[rays] = distance


def _draw_box(rng, picture, depth, ray, slope, ahead) -> None:
    """Draw a box on the floor: a ray meets it if it enters the last of its three slabs before it leaves the first."""
    size = np.exp(rng.uniform(-2.3, 0.3, 3))
    low = np.array([rng.uniform(-3, 3), -1.0, rng.uniform(1.2, 5)])
    ends = np.stack([low, low + size])
    rays = _candidate_rays(ahead, ends)
    slabs = ends.astype(np.float32)[..., None] / slope[:, rays]
    enter, leave = np.minimum(*slabs), np.maximum(*slabs)
    hit = np.flatnonzero(enter.max(0) < leave.min(0))
    face = enter[:, hit].argmax(0)
    for axis in range(3):
        on_axis = hit[face == axis]
        _draw_plane(rng, picture, depth, ray, rays[on_axis], enter[axis, on_axis], axis)


def _candidate_rays(ahead: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return the rays that may meet a box ahead between points 2×3, by their position one unit ahead (2×P²)."""
    corners = ends[:, :2, None] / ends[:, 2]
    low, high = corners.min((0, 2)) - 1e-3, corners.max((0, 2)) + 1e-3
    return np.flatnonzero(((ahead > low[:, None]) & (ahead < high[:, None])).all(0))
