"""Procedural pictures: textures to dress objects in, backgrounds to put behind them.

In: a numpy generator. Out: P×P×3 in [0, 1], or uint8 for backgrounds. A photograph's background has detail at all
scales and regions of different materials; so have these: noise with the 1/f spectrum of natural pictures, clouds,
cells, bricks, stripes, checks and grain, in regions, with clutter in front. Before photographs of brick, grass and
roads, a network trained with plain walls and smooth clouds alone named half of the objects; with these it names three
quarters. Source of the spectrum: Field, JOSA A 4 (1987) 2379.
"""

import numpy as np

from patchproof.base.color import codes_from_srgb

_SQUARE_PX = 4  # squares whose corners are looked up first; with 8 textures took up to half as long again


def texture(rng: np.random.Generator, px: int = 64) -> np.ndarray:
    """Return P×P×3 in [0, 1]: one of the patterns in random colors, with some natural unevenness."""
    blend = _PATTERNS[int(rng.choice(len(_PATTERNS), p=_SHARES))](rng, px)
    first, second, uneven = color(rng), color(rng), rng.random() < 0.5
    picture = _mix(first, second, blend)
    if uneven:
        picture += (rng.uniform(0, 0.25) * (natural(rng, px) - 0.5))[..., None]
    return np.clip(picture, 0, 1, out=picture)


def background(rng: np.random.Generator, px: int = 128) -> np.ndarray:
    """Return P×P×3 uint8: plain or a gradient (a third), or up to three textures; most with clutter in front."""
    import cv2

    if rng.random() < 0.33:
        picture = _gradient(rng, px)
        pieces = int(rng.integers(0, 12)) if rng.random() < 0.6 else 0
    else:
        picture, pieces = texture(rng, px), int(rng.integers(0, 12)) if rng.random() < 0.7 else 0
        for _ in range(int(rng.integers(0, 3))):
            picture = np.where(_half_plane(rng, px)[..., None], texture(rng, px), picture)
    for _ in range(pieces):
        mask = np.zeros((px, px), np.uint8)
        center, size = rng.integers(0, px, 2).tolist(), rng.integers(3, px // 3, 2).tolist()
        if rng.random() < 0.5:
            cv2.ellipse(mask, center, size, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        else:
            corners = cv2.boxPoints((center, [2 * s for s in size], float(rng.uniform(0, 180) * (rng.random() < 0.5))))
            cv2.fillPoly(mask, [corners.astype(np.int32)], 1)
        stuff = texture(rng, px) if rng.random() < 0.3 else color(rng)
        covered = mask == 1
        picture[covered] = stuff[covered] if stuff.ndim == 3 else stuff
    picture = picture * (1 + rng.uniform(0, 0.8) * (_gradient(rng, px).mean(2, keepdims=True) - 0.5))  # uneven light
    blur_px = float(rng.choice([0.3, 0.6, 1.0, 2.0, 3.0], p=[0.35, 0.25, 0.2, 0.1, 0.1]))
    return codes_from_srgb(cv2.GaussianBlur(picture, (0, 0), blur_px))


def color(rng: np.random.Generator) -> np.ndarray:
    """Return 3 numbers in [0, 1]: any color, more often a grayish one than a strong one."""
    strong = rng.random(3)
    return strong.mean() + (strong - strong.mean()) * rng.uniform(0, 1) ** 1.5


def natural(rng: np.random.Generator, px: int) -> np.ndarray:
    """Draw noise P×P in [0, 1] with amplitude 1/f^a and the mean and spread of a photograph."""
    stretch = np.exp(rng.normal(0, 0.4))  # grass and water have a direction
    noise, steepness = rng.normal(size=(px, px)), rng.uniform(0.5, 1.6)
    fy, fx = np.fft.fftfreq(px)[:, None], np.fft.rfftfreq(px)[None]
    frequency = np.hypot(fy * stretch, fx / stretch)
    frequency[0, 0] = np.inf
    field = np.fft.irfft2(np.fft.rfft2(noise) / frequency**steepness, (px, px))
    return np.clip(0.5 + 0.25 * field / field.std(), 0, 1)


def _clouds(rng: np.random.Generator, px: int) -> np.ndarray:
    import cv2

    steepness, octaves = rng.uniform(0.4, 0.9), [rng.random((2 ** (octave + 1) + 1,) * 2) for octave in range(5)]
    total = np.zeros((px, px))
    for octave, coarse in enumerate(octaves):
        total += steepness**octave * cv2.resize(coarse, (px, px), interpolation=cv2.INTER_CUBIC)
    return (total - total.min()) / max(np.ptp(total), 1e-9)


def _cells(rng: np.random.Generator, px: int) -> np.ndarray:
    """Draw gravel, leaves, a crowd: each pixel has the shade of the nearest of some points."""
    points = rng.random((int(np.exp(rng.uniform(np.log(8), np.log(800)))), 2)) * px
    shades, darkening = rng.random(len(points)), rng.uniform(0, 1)
    index = _nearest(points, px)
    down, across = np.mgrid[:px, :px] - points.T[:, index]
    distance = np.sqrt(down**2 + across**2)
    return shades[index] * np.clip(1.2 - distance / max(distance.max(), 1e-9) * darkening, 0, 1)


def _nearest(points: np.ndarray, px: int) -> np.ndarray:
    """Return P×P: the index of the nearest of points M×2 to each pixel. The pixels nearest to one point are a convex
    region, so that a square whose corners all have the same nearest point needs no further queries.
    """
    from scipy.spatial import KDTree

    tree, corners = KDTree(points), np.arange(0, px + _SQUARE_PX, _SQUARE_PX)
    at_corners = np.asarray(tree.query(np.stack(np.meshgrid(corners, corners, indexing="ij"), 2))[1])
    first, others = at_corners[:-1, :-1], (at_corners[1:, :-1], at_corners[:-1, 1:], at_corners[1:, 1:])
    uniform = np.logical_and.reduce([first == other for other in others])
    index, mixed = (values.repeat(_SQUARE_PX, 0).repeat(_SQUARE_PX, 1)[:px, :px] for values in (first, ~uniform))
    index[mixed] = tree.query(np.argwhere(mixed))[1]
    return index


def _bricks(rng: np.random.Generator, px: int) -> np.ndarray:
    """Draw rows of bricks or slabs, each of its own shade, with joints."""
    high, wide, shift = rng.uniform(4, 18), rng.uniform(6, 40), rng.choice([0.5, 0.0, 0.33])
    shade, strength, joints = rng.random((px, px)), rng.uniform(0.1, 0.8), rng.uniform(0.5, 2, 2)
    y, x = np.mgrid[:px, :px].astype(float)
    row = np.floor(y / high)
    x = x + row * wide * shift
    joint = ((y % high) < joints[0]) | ((x % wide) < joints[1])
    return np.where(joint, 1.0, (shade * strength)[row.astype(int), (x // wide).astype(int) % px])


def _stripes(rng: np.random.Generator, px: int) -> np.ndarray:
    turn, waves, threshold = rng.uniform(0, np.pi), rng.uniform(1.5, 14), rng.uniform(-0.8, 0.8)
    y, x = np.mgrid[:px, :px] / px
    return (np.sin(2 * np.pi * waves * (x * np.cos(turn) + y * np.sin(turn))) > threshold).astype(float)


def _checks(rng: np.random.Generator, px: int) -> np.ndarray:
    y, x = np.mgrid[:px, :px] / px * rng.uniform(1.5, 14)
    return (np.floor(x) + np.floor(y)) % 2


_PATTERNS = (natural, _clouds, _cells, _bricks, _stripes, _checks)
_PATTERNS += (lambda rng, px: rng.random((px, px)), lambda rng, px: np.zeros((px, px)))  # grain, and none
_SHARES = (0.25, 0.1, 0.15, 0.12, 0.1, 0.06, 0.07, 0.15)


def _gradient(rng: np.random.Generator, px: int) -> np.ndarray:
    y, x = np.mgrid[:px, :px] / px
    angle, first, second = rng.uniform(0, 2 * np.pi), color(rng), color(rng)
    blend = 0.5 + rng.uniform(0, 0.8) * ((x - 0.5) * np.cos(angle) + (y - 0.5) * np.sin(angle))
    picture = _mix(first, second, blend)
    return np.clip(picture, 0, 1, out=picture)


def _mix(first: np.ndarray, second: np.ndarray, blend: np.ndarray) -> np.ndarray:
    """Mix two colors by a share P×P of the second; channel by channel in memory, three times as fast."""
    picture = np.empty((3, *blend.shape))
    for channel, (a, b) in enumerate(zip(first, second, strict=True)):
        picture[channel] = a + (b - a) * blend
    return picture.transpose(1, 2, 0)


def _half_plane(rng: np.random.Generator, px: int) -> np.ndarray:
    """Return the mask P×P of one side of a random line, level in half of the cases: floor and wall, road and sky."""
    y, x = np.mgrid[:px, :px] / px
    angle = np.pi / 2 if rng.random() < 0.5 else rng.uniform(0, 2 * np.pi)
    return (x - rng.random()) * np.cos(angle) + (y - rng.random()) * np.sin(angle) > 0
