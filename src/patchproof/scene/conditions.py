"""Conditions: draws from a scene's ranges of pose, light, background, print and camera (expectation over
transformation).

In: the scene's settings and a stream. Out: `Conditions`, arrays of one value per view in physical units. Five streams
share nothing: what trains, what selects, what is promised, what is reprinted and what is evaluated. Training and
selection use scrambled Sobol points, which cover the ranges with fewer views; the others draw independently, so that
their intervals hold. All follow from one seed, and a view's draw depends on its index alone: step 70 sees the same
views after a resume.

Source of EoT: Athalye et al., Synthesizing Robust Adversarial Examples, ICML 2018.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from patchproof.color import tinted_white
from patchproof.settings import PrinterSettings, SceneSettings

Stream = Literal["train", "select", "promise", "reprint", "evaluate"]
_STREAMS = ("train", "select", "promise", "reprint", "evaluate")
_SOBOL = {"train", "select"}

# The sun and lamps stand within these angles of the patch's side: from behind, nothing on the patch could be seen.
LIGHT_AZIMUTH_DEG = (-90.0, 90.0)
LIGHT_ELEVATION_DEG = (10.0, 80.0)


@dataclass(frozen=True)
class Conditions:
    """N draws; every array has N rows. Angles are relative to the patch's side, offsets are shares of the object's
    length.
    """

    azimuth_deg: np.ndarray
    elevation_deg: np.ndarray
    distance_mm: np.ndarray
    roll_deg: np.ndarray
    look_at_offset: np.ndarray  # N×3
    ambient: np.ndarray
    directional: np.ndarray
    light_azimuth_deg: np.ndarray
    light_elevation_deg: np.ndarray
    background: np.ndarray  # N×5 in [0, 1): which picture, crop size, crop x, crop y, mirrored
    exposure_ev: np.ndarray
    white_balance: np.ndarray  # N×3 gains of red, green, blue
    blur_px: np.ndarray  # Gaussian sigma at the photograph's full size
    noise: np.ndarray  # standard deviation at white, in linear light, at full size
    jpeg: np.ndarray  # quality
    dot_gain: np.ndarray  # these three as in `channel.printer.vary`
    density: np.ndarray
    black: np.ndarray
    noise_seed: np.ndarray  # int64
    point: np.ndarray  # a lamp's light on the patch's middle where it faces the lamp
    point_azimuth_deg: np.ndarray
    point_elevation_deg: np.ndarray
    point_distance_mm: np.ndarray  # from the patch's middle
    sh2: np.ndarray  # standard deviation of the ambient light over directions, share of its mean
    sh2_coefficients: np.ndarray  # N×8 standard normal, as `channel.light` orders them: alike in all directions
    gloss: np.ndarray
    shininess: np.ndarray
    motion_px: np.ndarray  # length at the photograph's full size
    motion_deg: np.ndarray  # in [0, 180), counter-clockwise from the picture's x
    vignetting: np.ndarray  # share of the light lost in the photograph's corners
    paper: np.ndarray  # N×3 light of bare paper, beside the sheet that the light is measured by
    misregistration_mm: np.ndarray  # N×2×2: how far the planes of red and blue are moved on paper, right and down
    printed_scale: np.ndarray  # the piece's size over the sheet's own

    def __len__(self) -> int:
        return len(self.azimuth_deg)

    def __getitem__(self, rows) -> Conditions:
        """The draws at a slice or index array."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})


_POSES = ("azimuth_deg", "elevation_deg", "distance_mm", "roll_deg", "look_at_offset", "background", "printed_scale")
_DIMENSIONS = 43
# What prints may do beyond varying has draws of its own, independent in every stream: scenes without it keep theirs.
_PRINT_DIMENSIONS = 6
# Normal coefficients come from the middle of the unit interval: 3.1 standard deviations at most, never infinity.
_NORMAL_MARGIN = 1e-3


def draw(settings: SceneSettings, stream: Stream, n: int, seed: int, start: int = 0) -> Conditions:
    """Draws `start` to `start + n` of a stream."""
    number = _STREAMS.index(stream)
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, number])))
    print_rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, number, 1])))
    u = np.concatenate([_unit(stream, rng, start + n), print_rng.random((start + n, _PRINT_DIMENSIONS))], 1)
    return _from_unit(settings, u[start:], seed * len(_STREAMS) + number, start)


def with_poses_of(conditions: Conditions, poses: Conditions) -> Conditions:
    """`conditions` seen from the cameras and before the backgrounds of `poses`, row by row.

    What was rasterized for `poses` serves for the result, too: light, print and camera need no rasterizing.
    """
    if len(conditions) != len(poses):
        raise ValueError(f"{len(conditions)} conditions cannot take the poses of {len(poses)}")
    return replace(conditions, **{name: getattr(poses, name) for name in _POSES})


def with_value(conditions: Conditions, name: str, value) -> Conditions:
    """`conditions` with one of their arrays set to `value` (a number, or one per draw) and all others as drawn."""
    drawn = getattr(conditions, name)
    return replace(conditions, **{name: np.broadcast_to(np.asarray(value, drawn.dtype), drawn.shape).copy()})


def _unit(stream: Stream, rng: np.random.Generator, n: int) -> np.ndarray:
    """n×D points of the unit cube; the first k do not depend on n."""
    if stream not in _SOBOL:
        return rng.random((n, _DIMENSIONS))
    from scipy.stats import qmc

    return qmc.Sobol(_DIMENSIONS, rng=rng).random_base2(max(n - 1, 1).bit_length())[:n]


def _from_unit(settings: SceneSettings, u: np.ndarray, salt: int, start: int) -> Conditions:
    view, light, camera = settings.view, settings.light, settings.camera
    column = iter(u.T)

    def within(low_high) -> np.ndarray:
        low, high = low_high
        return low + (high - low) * next(column)

    jitter = (-view.look_at_jitter, view.look_at_jitter)
    spread = np.log1p(camera.white_balance)
    pose = [within(r) for r in (view.azimuth_deg, view.elevation_deg, view.distance_mm, view.roll_deg)]
    offset = np.stack([within(jitter) for _ in range(3)], 1)
    lights = [within(r) for r in (light.ambient, light.directional, LIGHT_AZIMUTH_DEG, LIGHT_ELEVATION_DEG)]
    background = np.stack([next(column) for _ in range(5)], 1)
    exposure = within(camera.exposure_ev)
    red, blue = within((-spread, spread)), within((-spread, spread))
    gains = np.exp(np.stack([red, np.zeros_like(red), blue], 1))
    blur, noise = within(camera.blur_px), within(camera.noise)
    jpeg = np.round(within(camera.jpeg)).astype(np.int64)
    printed = [within(r) for r in (settings.printer.dot_gain, settings.printer.density, settings.printer.black)]
    # each view's noise is its own, whatever batch it is rendered in
    noise_seed = (salt * 1_000_003 + start + np.arange(len(u))).astype(np.int64)
    point = [within(r) for r in (light.point, LIGHT_AZIMUTH_DEG, LIGHT_ELEVATION_DEG, light.point_distance_mm)]
    uneven = [within(light.sh2), _normal(np.stack([next(column) for _ in range(8)], 1))]
    gloss = [within(light.gloss), within(light.shininess)]
    motion = [within(camera.motion_px), within((0.0, 180.0))]
    everyday = (*pose, offset, *lights, background, exposure, gains, blur, noise, jpeg, *printed, noise_seed)
    rest = within(camera.vignetting), *_printed(settings.printer, column)
    return Conditions(*everyday, *point, *uneven, *gloss, *motion, *rest)


def _printed(printer: PrinterSettings, column: Iterator[np.ndarray]) -> tuple[np.ndarray, ...]:
    """Paper, misregistration in any direction, and scale."""

    def within(low_high) -> np.ndarray:
        low, high = low_high
        return low + (high - low) * next(column)

    paper = tinted_white(within(printer.paper_white), within(printer.paper_b))
    shift, directions = within(printer.misregistration_mm), np.stack([next(column), next(column)], 1) * 2 * np.pi
    moved = shift[:, None, None] * np.stack([np.cos(directions), np.sin(directions)], -1)
    return paper, moved, within(printer.scale)


def _normal(u: np.ndarray) -> np.ndarray:
    from scipy.special import ndtri

    return ndtri(_NORMAL_MARGIN + (1 - 2 * _NORMAL_MARGIN) * u)
