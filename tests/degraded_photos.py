"""Photographs of a sheet that is bent, folded, wobbly, blurred, covered, cropped: a kind, a seed, and the exact truth.

In: the name of a kind in `KINDS`, a seed. Out: a `Degraded`: a JPEG file with its EXIF data, where page points lie in
it, and where the camera stood. The sheet is one of `bent_paper`; a picture is made by throwing 64 samples per square
millimeter of the page into it, those nearest to the camera.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial

import cv2
import numpy as np
from bent_paper import (
    CENTER,
    DESIGNS,
    PAGE_PER_MM,
    SIDE_MM,
    Place,
    bent,
    camera,
    cone,
    flat,
    folded,
    printed,
    printed_page,
    rolled,
    sheet,
)
from PIL import Image
from scipy.sparse import csc_array
from synthetic_photos import noisy_design, some_design

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.geometry import look_at, view_angles
from patchproof.evidence.surface import PromisedColors, Surface

SIZE = (1200, 900)
FOCAL_35MM = 36
FOCAL = FOCAL_35MM / 43.2666 * float(np.hypot(*SIZE))


@dataclass(frozen=True)
class Degraded:
    """A file and its truth: `px` of page points; azimuth, elevation, distance and tilt as the sheet's middle has them.

    Tilt is that of the sheet without its wobble.
    """

    jpeg: bytes
    px: Callable[[np.ndarray], np.ndarray]
    azimuth_deg: float
    tilt_deg: float
    distance_mm: float


@dataclass
class Draw:
    """What one photograph is taken of and under; kinds change it."""

    rng: np.random.Generator
    place: Place
    camera_from_page: np.ndarray
    bends: bool = False  # whether the piece has markers in the middle of its sides, too
    design: str = "noisy"
    blur_px: float = 0.6
    motion_px: float = 0.0
    noise: float = 0.004
    light: float = 0.8
    jpeg: int = 90
    lens: float = 0.0  # radial term at the picture's corner
    wobble_px: float = 0.0
    on_light: list[Callable[[np.ndarray], np.ndarray]] = field(default_factory=list)  # linear light, before blur
    crop: tuple[int, int, int, int] | None = None  # x, y, width, height of what is left
    zoom: float = 1.0  # digital: the middle, enlarged
    exif: dict[int, object] = field(default_factory=dict)
    twin: np.ndarray | None = None  # where the camera is, as a second print of the sheet has it
    twin_sheet: str = "TESTSHEET0"  # of the second print
    warp: Callable[[np.ndarray], np.ndarray] | None = None  # of pixels N×2 from the picture's middle
    codes: Callable[[np.ndarray], np.ndarray] | None = None  # what is printed in place of the design
    stretch: np.ndarray | float = 1.0  # of the whole print, along x and y
    moved: np.ndarray | None = None  # 2×3: where the design was printed, in mm from the sheet's middle
    marker_shift_mm: tuple[float, float] = (0.0, 0.0)
    inks: Callable[[np.ndarray], np.ndarray] | None = None  # the page's linear light by other inks


def fresh(rng: np.random.Generator) -> Draw:
    """A flat sheet under usual conditions."""
    aside = rng.uniform(-40, 40, 2)
    where = camera(rng.uniform(-45, 45), rng.uniform(-20, 25), rng.uniform(380, 620), rng.uniform(-15, 15), aside)
    design = str(rng.choice(["noisy", "noisy", "smooth", "plain"]))
    return Draw(rng, flat, where, design=design, blur_px=rng.uniform(0.4, 0.9))


def _changed(**changes) -> Callable[[Draw], Draw]:
    return lambda d: replace(d, **{k: v(d.rng) if callable(v) else v for k, v in changes.items()})


def _bent_by(make: Callable[[np.random.Generator], Place], bends=None) -> Callable[[Draw], Draw]:
    return lambda d: replace(d, place=make(d.rng), bends=bool(d.rng.random() < 0.5) if bends is None else bends)


def _axis(rng) -> float:
    """Along x or y, half of the time somewhere between."""
    return float(rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi), rng.uniform(0, np.pi)]))


def _sign(rng) -> float:
    return float(rng.choice([-1.0, 1.0]))


def _roll(low: float, high: float, sign=None, bends=None):
    def make(rng):
        radius = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return rolled((sign or _sign(rng)) * radius, float(rng.choice([0.0, np.pi / 2])))

    def change(d: Draw) -> Draw:
        rng = d.rng
        where = camera(_sign(rng) * rng.uniform(0, 50), rng.uniform(-10, 10), rng.uniform(380, 620), rng.uniform(-5, 5))
        return replace(_bent_by(make, bends)(d), camera_from_page=where)

    return change


def _fold(angle: float):
    return _bent_by(lambda rng: folded(_sign(rng) * angle, rng.uniform(2, 45) * _sign(rng), _axis(rng)))


def _wave(rng):
    length, height, start = rng.uniform(60, 160), rng.uniform(1.5, 5), rng.uniform(0, 2 * np.pi)
    steep = 2 * np.pi * height / length
    return bent(lambda way: np.arctan(steep * np.sin(2 * np.pi * way / length + start)), _axis(rng))


def _ear(rng):
    angle, reach = np.radians(rng.uniform(30, 80)), rng.uniform(55, 75)
    return bent(lambda way: angle * (way > reach), np.pi / 4)


def _shade(d: Draw) -> Draw:
    """Half of the picture in shadow, with an edge of a few pixels through its middle."""
    rng = d.rng
    angle, depth, soft = rng.uniform(0, np.pi), rng.uniform(0.2, 0.6), rng.uniform(0.5, 8)

    def shade(light):
        y, x = np.mgrid[: light.shape[0], : light.shape[1]] - np.array(light.shape[:2])[:, None, None] / 2
        side = (x * np.cos(angle) + y * np.sin(angle)) / soft
        return light * (depth + (1 - depth) / (1 + np.exp(-np.clip(side, -50, 50))))[..., None]

    return replace(d, on_light=[shade])


def _glare(d: Draw) -> Draw:
    """A lamp's reflection somewhere on the sheet."""
    at, wide, bright = d.rng.uniform(-150, 150, 2), d.rng.uniform(15, 60), d.rng.uniform(0.5, 2.0)

    def glare(light):
        y, x = np.mgrid[: light.shape[0], : light.shape[1]] - np.array(light.shape[:2])[:, None, None] / 2
        return light + bright * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 2 / wide**2)[..., None]

    return replace(d, on_light=[glare])


def _moire(d: Draw) -> Draw:
    """Stripes of a screen."""
    period, angle, depth = d.rng.uniform(2.2, 12), d.rng.uniform(0, np.pi), d.rng.uniform(0.05, 0.25)

    def stripes(light):
        y, x = np.mgrid[: light.shape[0], : light.shape[1]]
        wave = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
        return light * (1 + depth * wave)[..., None]

    return replace(d, on_light=[stripes])


def _cover(d: Draw) -> Draw:
    """A card or thumb over a part of the sheet, somewhere near it."""
    at, size, angle = d.rng.uniform(-170, 170, 2), d.rng.uniform(40, 170, 2), d.rng.uniform(0, 180)
    color = d.rng.uniform(0.03, 0.8, 3)

    def cover(light):
        quad = cv2.boxPoints((tuple(float(v) for v in at + np.array(light.shape[1::-1]) / 2), tuple(size), angle))
        light = light.copy()
        cv2.fillConvexPoly(light, quad.round().astype(np.int32), tuple(float(v) for v in color))
        return light

    return replace(d, on_light=[cover])


def _cropped(d: Draw, shape: str, tells: bool) -> Draw:
    """A part of the picture that still holds the sheet, in its own or another shape; `tells`: EXIF has the old size."""
    size = {"odd": (700, 655), "same": (720, 540), "middle": (720, 540)}[shape]
    free = np.array(SIZE) - size
    x, y = free // 2 if shape == "middle" else d.rng.choice([0.15, 0.85], 2) * free
    az = float(d.rng.uniform(-45, 45))  # the sheet in what is left
    matrix = np.array([x + size[0] / 2 - SIZE[0] / 2, y + size[1] / 2 - SIZE[1] / 2]) / FOCAL
    where = camera(az, d.rng.uniform(-20, 25), d.rng.uniform(380, 560))
    turn = look_at([0, 0, 0], [matrix[0], matrix[1], 1.0], 0, (0, -1, 0))  # the camera turns away from the sheet
    exif = {0xA002: SIZE[0], 0xA003: SIZE[1]} if tells else {0xA002: size[0], 0xA003: size[1]}
    return replace(d, crop=(int(x), int(y), *size), camera_from_page=turn.T @ where, exif=exif)


def _twin(d: Draw) -> Draw:
    """Two prints of one sheet side by side."""
    az, el, far = d.rng.uniform(-25, 25), d.rng.uniform(-15, 15), d.rng.uniform(520, 700)
    apart = d.rng.uniform(75, 85)
    return replace(
        d,
        camera_from_page=camera(az, el, far, 0, (apart, 0)),
        twin=camera(az + d.rng.uniform(-5, 5), el, far + d.rng.uniform(-20, 150), 0, (-apart, 0)),
    )


def _stretched(d: Draw) -> Draw:
    """Printed longer along one side by 1 to 5 %."""
    return replace(d, stretch=np.exp(_sign(d.rng) * d.rng.uniform(0.01, 0.05) * np.array([1.0, 0.0])))


def _squeezed(d: Draw) -> Draw:
    """Saved in another shape: longer along one side by 2 to 12 %."""
    scale = np.exp(_sign(d.rng) * d.rng.uniform(0.02, 0.12) * np.array([1.0, 0.0]))
    return replace(d, warp=lambda off: off * scale)


def _rolling_shutter(d: Draw) -> Draw:
    """Rows read while the camera moves: sheared, stretched, and shaken."""
    rng = d.rng
    shear, stretch, shake = rng.normal(0, 0.06), rng.normal(0, 0.03), rng.choice([0.0, 1.0]) * rng.uniform(0, 2)
    wave, start = 2 * np.pi / rng.uniform(200, 900), rng.uniform(0, 2 * np.pi)

    def warp(off: np.ndarray) -> np.ndarray:
        x, y = off.T
        return np.column_stack([x + shear * y + shake * np.sin(wave * y + start), y * (1 + stretch)])

    return replace(d, warp=warp)


def _keystone(d: Draw) -> Draw:
    """Perspective that software took away, all of it or a part, and the foreshortening with it; EXIF knows nothing."""
    rng = d.rng
    where = camera(_sign(rng) * rng.uniform(15, 45), rng.uniform(-20, 25), rng.uniform(380, 620))
    slope = rng.uniform(0.4, 1.0) * where[:2, 2] / where[2, 2] / FOCAL  # at 1 no vanishing line is left
    way, lengths, _ = np.linalg.svd(where[:2, :2])
    widen = way @ np.diag([1.0, (lengths[0] / lengths[1]) ** rng.uniform(0, 1)]) @ way.T
    return replace(d, camera_from_page=where, warp=lambda off: off @ widen / (1 + off @ slope)[:, None])


def _moved(d: Draw, what: str) -> Draw:
    """The design beside its place by 0.3 to 3 mm, or smaller or larger by 0.5 to 4 %."""
    rng = d.rng
    scale = np.exp(_sign(rng) * rng.uniform(0.005, 0.04)) if what == "scale" else 1.0
    way = rng.uniform(0, 2 * np.pi)
    shift = rng.uniform(0.3, 3) * np.array([np.cos(way), np.sin(way)]) if what == "shift" else np.zeros(2)
    return replace(d, moved=np.column_stack([scale * np.eye(2), shift]), design=_textured(d))


def _textured(d: Draw) -> str:
    return d.design if d.design != "plain" else "noisy"


def _displaced_marker(d: Draw) -> Draw:
    way = d.rng.uniform(0, 2 * np.pi)
    shift = d.rng.uniform(0.3, 3) * np.array([np.cos(way), np.sin(way)])
    return replace(d, marker_shift_mm=tuple(shift), bends=bool(d.rng.random() < 0.5))


def _small_ear(rng):
    angle, reach = np.radians(rng.uniform(60, 150)), rng.uniform(72, 90)
    return bent(lambda way: angle * (way > reach), np.pi / 4 + rng.integers(4) * np.pi / 2)


def _second(d: Draw, how: str) -> Draw:
    """A second print: partly out of the picture, far behind, covered, or of another sheet."""
    rng, d = d.rng, _twin(d)
    assert d.twin is not None
    if how == "cut":
        az, el, far = rng.uniform(-25, 25), rng.uniform(-15, 15), rng.uniform(450, 600)
        half = far / FOCAL * SIZE[0] / 2
        where = camera(az, el, far, 0, (half * rng.uniform(0.3, 0.5), 0))
        return replace(d, camera_from_page=where, twin=camera(az, el, far, 0, (-half * rng.uniform(0.75, 1.0), 0)))
    if how == "far":
        far = rng.uniform(900, 2200)
        aside = far / FOCAL * SIZE[0] / 2 * rng.uniform(0.3, 0.8)
        return replace(d, twin=camera(rng.uniform(-30, 30), rng.uniform(-20, 20), far, 0, (-aside, 0)))
    if how == "covered":
        left = bool(rng.random() < 0.5)

        def cover(light: np.ndarray) -> np.ndarray:
            quad = _twin_px(d) if left else _twin_px(d)[[1, 0, 3, 2]]
            part = np.array(
                [quad[0], quad[0] + 0.6 * (quad[1] - quad[0]), quad[3] + 0.6 * (quad[2] - quad[3]), quad[3]]
            )
            light = light.copy()
            cv2.fillConvexPoly(light, part.round().astype(np.int32), (0.3, 0.25, 0.2))
            return light

        return replace(d, on_light=[cover])
    return replace(d, twin_sheet="OTHERSHEET")


def _corner_cut(d: Draw, eared: bool) -> Draw:
    """A marker partly beyond the picture's right edge; its corner may be folded, too."""
    rng, roll, far = d.rng, _sign(d.rng) * d.rng.uniform(12, 30), d.rng.uniform(380, 500)
    corners = SIDE_MM / 2 * np.array([[1, 1], [1, -1]])
    angle, reach, azimuth, cut = np.radians(rng.uniform(60, 150)), *rng.uniform([72, -30, 2], [90, 30, 12])
    for aside in range(400):
        d = replace(d, camera_from_page=camera(azimuth, 5, far, roll, (-aside, 0)))
        x = _projected(d, flat(corners), d.camera_from_page, np.zeros_like)[0][:, 0]
        if x.max() > SIZE[0] + cut:
            break
    way = np.arctan2(*corners[x.argmax()][::-1])
    return replace(d, place=bent(lambda along: angle * (along > reach), way)) if eared else d


def _twin_px(d: Draw) -> np.ndarray:
    corners = np.array([[-80, -80], [80, -80], [80, 80], [-80, 80.0]])
    return _projected(d, flat(corners), d.twin, np.zeros_like)[0]


def _foreign(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable[[Draw], Draw]:
    return lambda d: replace(d, design=_textured(d), codes=lambda codes: change(codes, d.rng))


def _other_design(codes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    other = (
        noisy_design(int(rng.integers(1, 1000))) * 255 if rng.random() < 0.5 else some_design(int(rng.integers(9, 999)))
    )
    return other.astype(np.uint8)


def _mean_color(codes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.broadcast_to(srgb_from_linear(linear_from_srgb(codes / 255).mean((0, 1))) * 255, codes.shape).astype(
        np.uint8
    )


def _tiles(codes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    tiles = codes.reshape(14, 10, 14, 10, 3).swapaxes(1, 2).reshape(196, 10, 10, 3)[rng.permutation(196)]
    return tiles.reshape(14, 14, 10, 10, 3).swapaxes(1, 2).reshape(codes.shape)


def _older(codes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """An earlier version of the design: its coarse colors, but other detail."""
    coarse = cv2.resize(codes, (4, 4), interpolation=cv2.INTER_AREA)
    coarse = cv2.resize(coarse, codes.shape[1::-1], interpolation=cv2.INTER_CUBIC).astype(float)
    detail = noisy_design(int(rng.integers(1, 1000))) * 255
    return np.clip(coarse + 0.7 * (detail - cv2.GaussianBlur(detail, (0, 0), 15)), 0, 255).astype(np.uint8)


# densities of red, green and blue by cyan, magenta and yellow ink
_DYES = np.array([[1.0, 0.3, 0.1], [0.15, 1.0, 0.35], [0.03, 0.12, 1.0]])


def _inks(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Callable[[Draw], Draw]:
    """Densities of cyan, magenta and yellow changed; black ink, which prints some of the dark, is not."""

    def changed(d: Draw) -> Draw:
        black = float(d.rng.choice([0.0, 0.8]))

        def inks(light: np.ndarray) -> np.ndarray:
            dyes = np.maximum(-np.log10(np.maximum(light, 1e-3)) @ np.linalg.inv(_DYES), 0)
            key = black * dyes.min(-1, keepdims=True)
            return 10 ** -(change(dyes - key, d.rng) @ _DYES + key * _DYES.sum(0))

        return replace(d, design=_textured(d), inks=inks)

    return changed


def _without(ink: int):
    return _inks(lambda dyes, rng: dyes * (np.arange(3) != ink))


def _banded(dyes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Clogged nozzles: bands in which an ink is missing."""
    rows = np.arange(len(dyes)) / PAGE_PER_MM
    missing = np.sin(2 * np.pi * rows / rng.uniform(2, 9) + rng.uniform(0, 6)) > rng.uniform(0.2, 0.7)
    ink = int(rng.integers(3))
    return dyes * (1 - missing[:, None, None] * (np.arange(3) == ink))


def _flat_far(d: Draw) -> Draw:
    """A whole flat card whose markers are 11 to 17 px across."""
    rng = d.rng
    return replace(
        d,
        bends=bool(rng.random() < 0.5),
        camera_from_page=camera(rng.uniform(-40, 40), rng.uniform(-15, 20), rng.uniform(1000, 1500), 0, (40, 20)),
        noise=float(rng.choice([0.004, 0.008, 0.012])),
    )


MILD = ("plain", "defocus_1", "noise_mild", "jpeg_60", "motion_2", "shadow", "far", "lens_mild", "roll_300_1000_bends")
KINDS: dict[str, Callable[[Draw], Draw]] = {
    "plain": lambda d: d,
    "plain_8_markers": _changed(bends=True),
    "noise_mild": _changed(noise=0.01),
    "noise": _changed(noise=0.04),
    "jpeg_60": _changed(jpeg=60),
    "jpeg_20": _changed(jpeg=20),
    "dark": _changed(light=0.03, noise=0.006),
    "defocus_1": _changed(blur_px=1.2),
    "defocus_2": _changed(blur_px=2.2),
    "defocus_4": _changed(blur_px=4.0),
    "motion_2": _changed(motion_px=2.0),
    "motion_4": _changed(motion_px=4.0),
    "motion_8": _changed(motion_px=8.0),
    "motion_12": _changed(motion_px=12.0),
    "far": _changed(camera_from_page=lambda rng: camera(rng.uniform(-45, 45), 5, rng.uniform(900, 1300))),
    "oblique": _changed(camera_from_page=lambda rng: camera(_sign(rng) * rng.uniform(50, 70), 5, 500)),
    "lens_mild": _changed(lens=lambda rng: rng.uniform(-0.01, 0.01)),
    "lens": _changed(lens=lambda rng: _sign(rng) * rng.uniform(0.02, 0.08)),
    "fold_10": _fold(10),
    "fold_30": _fold(30),
    "fold_60": _fold(60),
    "dog_ear": _bent_by(_ear),
    "wobble_1": _changed(wobble_px=1.0),
    "wobble_4": _changed(wobble_px=4.0),
    "wobble_12": _changed(wobble_px=12.0),
    "waves": _bent_by(_wave),
    "cone": _bent_by(lambda rng: cone(_sign(rng) * rng.uniform(0.1, 0.6), rng.uniform(0.3, 0.9), _axis(rng))),
    "roll_60_100_bends": _roll(60, 100, bends=True),
    "roll_100_300_bends": _roll(100, 300, bends=True),
    "roll_300_1000_bends": _roll(300, 1000, bends=True),
    "roll_60_100": _roll(60, 100, bends=False),
    "roll_100_300": _roll(100, 300, bends=False),
    "roll_300_1000": _roll(300, 1000, bends=False),
    "roll_any_axis": _bent_by(lambda rng: rolled(_sign(rng) * rng.uniform(100, 400), _axis(rng)), True),
    "shadow": _shade,
    "glare": _glare,
    "moire": _moire,
    "covered": _cover,
    "two_prints": _twin,
    "crop_told": partial(_cropped, shape="odd", tells=True),
    "crop_odd": partial(_cropped, shape="odd", tells=False),
    "crop_aside": partial(_cropped, shape="same", tells=False),
    "crop_middle_told": partial(_cropped, shape="middle", tells=True),
    "zoom_told": lambda d: replace(
        d, zoom=2.0, exif={0xA404: 2.0}, camera_from_page=camera(d.rng.uniform(-45, 45), 5, 900)
    ),
    "dog_ear_small": _bent_by(_small_ear),
    "second_cut": partial(_second, how="cut"),
    "second_far": partial(_second, how="far"),
    "second_covered": partial(_second, how="covered"),
    "second_other": partial(_second, how="other"),
    "stretched": _stretched,
    "squeezed": _squeezed,
    "rolling_shutter": _rolling_shutter,
    "keystone": _keystone,
    "design_shifted": partial(_moved, what="shift"),
    "design_scaled": partial(_moved, what="scale"),
    "marker_displaced": _displaced_marker,
    "other_design": _foreign(_other_design),
    "mean_color": _foreign(_mean_color),
    "gray": _foreign(lambda codes, rng: np.full_like(codes, 128)),
    "noise_cells": _foreign(lambda codes, rng: rng.integers(0, 256, (14, 14, 3), np.uint8).repeat(10, 0).repeat(10, 1)),
    "tiles": _foreign(_tiles),
    "mirrored_design": _foreign(lambda codes, rng: codes[:, ::-1]),
    "turned_design": _foreign(lambda codes, rng: np.rot90(codes, int(rng.integers(1, 4)))),
    "inverted": _foreign(lambda codes, rng: 255 - codes),
    "older": _foreign(_older),
    "no_cyan": _without(0),
    "no_magenta": _without(1),
    "no_yellow": _without(2),
    "swapped_inks": _inks(lambda dyes, rng: dyes[..., [(1, 0, 2), (2, 1, 0), (0, 2, 1)][int(rng.integers(3))]]),
    "banded": _inks(_banded),
    "draft_gray": _inks(lambda dyes, rng: dyes.mean(-1, keepdims=True) * np.full(3, rng.uniform(0.5, 1.0))),
    "corner_cut": partial(_corner_cut, eared=False),
    "corner_cut_ear": partial(_corner_cut, eared=True),
    "flat_far": _flat_far,
}


def take(kind: str, seed: int) -> tuple[Degraded, Surface, PromisedColors]:
    """One photograph of that kind, and what it is measured against."""
    number = list(KINDS).index(kind)
    draw = KINDS[kind](fresh(np.random.default_rng([seed, number])))
    surface, promised = sheet(draw.bends, draw.design)
    page = _page(draw)
    wobble = _wobble(draw)

    def px(mm: np.ndarray, camera_from_page=draw.camera_from_page) -> np.ndarray:
        mm = np.asarray(mm, float) - CENTER
        mm = mm if draw.moved is None else mm @ draw.moved[:, :2].T + draw.moved[:, 2]
        return _projected(draw, draw.place(mm * draw.stretch), camera_from_page, wobble)[0]

    light = _background(draw)
    samples = _samples() if np.all(draw.stretch == 1) else _samples() * draw.stretch
    light = _laid_on(light, page, *_projected(draw, draw.place(samples), draw.camera_from_page, wobble))
    if draw.twin is not None:
        page = printed(draw.bends, DESIGNS[draw.design](), draw.twin_sheet).reshape(-1, 3)
        light = _laid_on(light, page, *_projected(draw, flat(_samples()), draw.twin, wobble))
    for change in draw.on_light:
        light = change(light)
    codes = _exposed(light, draw)
    around = 0.01 * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    unwarped = replace(draw, warp=None)
    right, left, below, above = _projected(unwarped, draw.place(around), draw.camera_from_page, np.zeros_like)[0]
    large, small = np.linalg.svd(np.stack([right - left, below - above], 1), compute_uv=False)
    azimuth, _, distance = view_angles(draw.camera_from_page, (0, 0))
    tilt = float(np.degrees(np.arccos(small / large)))
    return Degraded(_file(codes, draw), px, azimuth, tilt, distance), surface, promised


def _page(draw: Draw) -> np.ndarray:
    """The printed page's linear light, a row for each of `_samples`."""
    usual = draw.codes is None and draw.moved is None and draw.marker_shift_mm == (0.0, 0.0)
    codes = DESIGNS[draw.design]()
    if usual:
        page = printed_page(draw.bends, draw.design)
    else:
        page = printed(
            draw.bends,
            codes if draw.codes is None else draw.codes(codes),
            moved=draw.moved,
            marker_shift_mm=draw.marker_shift_mm,
        )
    return (page if draw.inks is None else draw.inks(page)).reshape(-1, 3)


@cache
def _samples() -> np.ndarray:
    """Page millimeters N×2 from the sheet's middle."""
    size = round(SIDE_MM * PAGE_PER_MM)
    return ((np.mgrid[:size, :size][::-1].reshape(2, -1) + 0.5) / PAGE_PER_MM).T - CENTER


def _projected(draw: Draw, points: np.ndarray, camera_from_page, wobble) -> tuple[np.ndarray, np.ndarray]:
    """Pixels N×2 of the file and depths N."""
    # coordinates lie in rows, which is faster
    seen = camera_from_page[:3, :3] @ points.T + camera_from_page[:3, 3:4]
    off = (seen[:2] * (FOCAL * draw.zoom / seen[2])).T
    if draw.lens:
        off *= 1 + draw.lens * (off**2).sum(1, keepdims=True) / (np.hypot(*SIZE) / 2) ** 2
    off = off if draw.warp is None else draw.warp(off)
    shift = np.zeros(2) if draw.crop is None else np.array(draw.crop[:2])
    px = off + (np.array(SIZE) / 2 - shift)
    return (px + wobble(px) if draw.wobble_px else px), seen[2]


def _wobble(draw: Draw) -> Callable[[np.ndarray], np.ndarray]:
    """A smooth random displacement of pixels whose standard deviation is 0.5 of its amplitude."""
    waves = 2 * np.pi / draw.rng.uniform(150, 500, (6, 1)) * _directions(draw.rng.uniform(0, 2 * np.pi, 6))
    phases, ways = draw.rng.uniform(0, 2 * np.pi, 6), _directions(draw.rng.uniform(0, 2 * np.pi, 6))
    if not draw.wobble_px:
        return np.zeros_like
    return lambda px: draw.wobble_px / np.sqrt(6) * np.sin(px @ waves.T + phases) @ ways


def _directions(angles: np.ndarray) -> np.ndarray:
    return np.column_stack([np.cos(angles), np.sin(angles)])


def _background(draw: Draw) -> np.ndarray:
    """A wall with a few soft patches of its own."""
    coarse = draw.rng.uniform(0.1, 0.35, (6, 8, 3)).astype(np.float32)
    size = SIZE if draw.crop is None else draw.crop[2:]
    return cv2.resize(coarse, size, interpolation=cv2.INTER_CUBIC)


def _laid_on(light, page, px, depth) -> np.ndarray:
    """The page's samples thrown into the picture's light, each into the four pixels about it, hidden ones left out."""
    height, width = light.shape[:2]
    x, y = np.ascontiguousarray(px.T)
    inside = (x > 1) & (x < width - 1) & (y > 1) & (y < height - 1)
    if not inside.all():
        x, y, depth, page = x[inside], y[inside], depth[inside], page[inside]
    # of the part of the picture that they reach
    left, right = max(int(x.min()) - 4, 0), min(int(x.max()) + 5, width)
    top, bottom = max(int(y.min()) - 4, 0), min(int(y.max()) + 5, height)
    light, part = light.copy(), (slice(top, bottom), slice(left, right))
    light[part] = _thrown(light[part], page, (x - left).astype(np.float32), (y - top).astype(np.float32), depth)
    return light


def _thrown(light, page, x, y, depth) -> np.ndarray:
    height, width = light.shape[:2]
    cell = (y * np.float32(0.25)).astype(np.int32) * (width // 4 + 1) + (x * np.float32(0.25)).astype(np.int32)
    nearest = np.full((height // 4 + 1) * (width // 4 + 1), np.inf)
    np.minimum.at(nearest, cell, depth)
    shown = depth < nearest[cell] + 12.0  # mm: what a steep part gains over four pixels
    if not shown.all():
        x, y, page = x[shown], y[shown], page[shown]
    x, y = x - np.float32(0.5), y - np.float32(0.5)
    left, top = x.astype(np.int32), y.astype(np.int32)
    right, below, corner = x - left.astype(np.float32), y - top.astype(np.float32), top * width + left
    # each column of the matrix is a sample's: what of it the four pixels about it get
    weights, pixels = np.empty((len(x), 4), np.float32), np.empty((len(x), 4), np.int32)
    for n, (dx, dy) in enumerate(((0, 0), (0, 1), (1, 0), (1, 1))):
        np.multiply(right if dx else 1 - right, below if dy else 1 - below, out=weights[:, n])
        np.add(corner, dy * width + dx, out=pixels[:, n])
    ends = np.arange(0, 4 * len(x) + 1, 4, dtype=np.int32)
    thrown = csc_array((weights.ravel(), pixels.ravel(), ends), (height * width, len(x)))
    colors = np.ones((len(page), 4), np.float32)
    colors[:, :3] = page
    total = (thrown @ colors).reshape(height, width, 4)
    dense = np.maximum(cv2.dilate(total[..., 3], np.ones((5, 5))), 1e-3)
    cover = np.clip(total[..., 3:] / dense[..., None] / 0.7, 0, 1)
    color = total[..., :3] / np.maximum(total[..., 3:], 1e-6)
    return light * (1 - cover) + color * cover


def _exposed(light: np.ndarray, draw: Draw) -> np.ndarray:
    """uint8 sRGB: blurred, moved, noisy."""
    linear = cv2.GaussianBlur(light * np.float32(draw.light), (0, 0), draw.blur_px)
    if draw.motion_px:
        way = _directions(draw.rng.uniform(0, np.pi, 1))[0] * draw.motion_px
        steps = np.linspace(-0.5, 0.5, max(5, round(3 * draw.motion_px)))
        moved = (np.array([[1, 0, s * way[0]], [0, 1, s * way[1]]]) for s in steps)
        size = linear.shape[1::-1]
        linear = sum(cv2.warpAffine(linear, m, size, borderMode=cv2.BORDER_REPLICATE) for m in moved) / len(steps)
    noise = draw.rng.standard_normal(linear.shape, np.float32)  # of megapixels: changed where it is
    noise *= np.float32(draw.noise)
    noise *= np.sqrt(np.maximum(linear, np.float32(0.02)))
    linear += noise
    codes = srgb_from_linear(np.clip(linear, 0, 1, out=linear))
    codes *= 255
    codes += 0.5
    return codes.astype(np.uint8)


def _file(codes: np.ndarray, draw: Draw) -> bytes:
    exif, buffer = Image.Exif(), io.BytesIO()
    details = exif.get_ifd(0x8769)
    details |= {0xA405: FOCAL_35MM, **draw.exif}
    for key, value in details.items():
        exif.get_ifd(0x8769)[key] = value
    Image.fromarray(codes).save(buffer, "JPEG", quality=draw.jpeg, exif=exif)
    return buffer.getvalue()
