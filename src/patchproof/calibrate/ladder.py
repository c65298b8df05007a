"""Choose from a ladder of models the simplest one whose held-out error is no worse than the best one's.

In: each model's error on every item while that item was held out, simplest model first. No worse means within one
standard error (Breiman's rule) of the *paired* difference from the best, item by item: items that are hard for every
model say nothing about which one is better.

Also: the ladder of maps from colors sent to colors seen, from identity to splines, with known printers as priors. Each
map is tested by ΔE00 on colors that it was not fitted to (ten folds; the corners of the RGB cube always stay in
training, so that no color outside of those seen is predicted). Too few or nearly gray colors leave only maps that fit
nothing, or paper and black. The splines (Duchon 1977) see each color as sRGB and as CIELAB together: drivers work in
either, and in one of them a printer is close to straight. With 48 swatches that reduced ΔE00 from 3.2 to 2.3 where the
driver looks for nearest colors, and cost 0.2 where it only mixes inks.

Sources: Breiman, Friedman, Olshen, Stone, Classification and Regression Trees, 1984, 3.4.3 (the rule of one standard
error); Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., 7.10 (cross-validation).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from patchproof.base.color import ciede2000, lab_from_srgb, linear_from_srgb, srgb_from_linear

Colors = np.ndarray  # N×3 sRGB in [0, 1]
ColorMap = Callable[[Colors], Colors]

FOLDS = 10
MIN_HELD_OUT = 6  # with fewer, a rung's mean error is meaningless
# Rms distance of the colors from their nearest plane; charts have 0.30 and more. Of charts with colors drawn towards
# gray, held-out errors were 1.0 to 1.5, other colors' up to 3 at 0.13, 4 at 0.06, 14 at 0.03, 35 at 0.001.
WELL_SPREAD_WIDTH, MIN_WIDTH = 0.15, 0.05
SMOOTHING = 1e-3  # of splines: held-out errors differ by less than 0.05 from 1e-4 to 1e-2
_LAB_SCALE = 60.0  # CIELAB units that count as much as the whole range of one sRGB channel


@dataclass(frozen=True)
class Rung:
    """A model's mean held-out error, how much worse than the best it is, its standard error; inf: no fit."""

    name: str
    error: float
    worse_by: float
    standard_error: float


def choose_rung(names: Sequence[str], errors: np.ndarray) -> tuple[int, tuple[Rung, ...]]:
    """The number of the rung to use, and all, of errors models × items; rows that are not finite had no fit."""
    means = np.where(np.isfinite(errors).all(1), errors.mean(1), np.inf)
    worse = errors[np.isfinite(means)] - errors[means.argmin()]
    by, spread = np.full((2, len(means)), np.inf)
    by[np.isfinite(means)] = worse.mean(1)
    spread[np.isfinite(means)] = worse.std(1, ddof=1) / np.sqrt(worse.shape[1]) if worse.shape[1] > 1 else 0.0
    rungs = tuple(map(Rung, names, means.tolist(), by.tolist(), spread.tolist()))
    return int(np.argmax(np.isfinite(means) & (by <= spread))), rungs


@dataclass(frozen=True)
class MapKind:
    """A kind of map: how to fit it, and the fewest distinct colors that this takes."""

    name: str
    fit: Callable[[Colors, Colors], ColorMap]
    min_colors: int
    endpoints_only: bool = False  # fits nothing, or paper and black only


@dataclass(frozen=True)
class MapChoice:
    """The chosen kind of map, fitted to all colors; `rungs` are all kinds tried, in ΔE00, simplest first."""

    chosen: Rung
    predict: ColorMap
    rungs: tuple[Rung, ...]
    colors: int
    held_out: int
    left_out: tuple[str, ...]  # kinds that need more colors, or more colorful ones
    width: float  # of the colors: rms distance from their nearest plane


def map_kinds(priors: Mapping[str, ColorMap]) -> tuple[MapKind, ...]:
    """All kinds, simplest first."""
    best = lambda sent, seen: min(priors.values(), key=lambda prior: color_difference(prior(sent), seen).mean())  # noqa: E731
    return (
        MapKind("identity", lambda sent, seen: lambda colors: colors, 0, True),
        MapKind("white_black", fit_white_black, 2, True),
        MapKind("affine", fit_affine, 12),
        MapKind("prior", best, 0, True),
        MapKind("prior+affine", partial(fit_prior_affine, priors), 12),
        MapKind("prior+affine+spline", partial(fit_prior_spline, priors), 24),
        MapKind("spline", fit_spline, 24),
    )


def choose_map(kinds: Sequence[MapKind], sent: Colors, seen: Colors) -> MapChoice:
    """Choose the simplest kind that is no worse than the best; repeated colors are averaged first."""
    sent, seen = average_repeats(sent, seen)
    corners, width = np.isin(sent, (0.0, 1.0)).all(1), color_width(sent)
    usable = [kind for kind in kinds if len(sent) >= kind.min_colors and (kind.endpoints_only or width >= MIN_WIDTH)]
    shuffled = np.random.default_rng(0).permutation(np.flatnonzero(~corners))
    folds = [fold for fold in np.array_split(shuffled, FOLDS) if len(fold)]
    if (~corners).sum() < MIN_HELD_OUT:
        ends = (sent == 1).all(1) | (sent.sum(1) == sent.sum(1).min())
        usable = [kind for kind in usable if kind.endpoints_only]
        folds = [np.flatnonzero(~ends if not ends.all() else ends)]
    errors = np.array([_held_out(kind, sent, seen, folds) for kind in usable])
    chosen, rungs = choose_rung([kind.name for kind in usable], errors)
    left_out = tuple(kind.name for kind in kinds if kind not in usable)
    return MapChoice(rungs[chosen], usable[chosen].fit(sent, seen), rungs, len(sent), errors.shape[1], left_out, width)


def color_width(colors: Colors) -> float:
    """Rms distance of N×3 colors from their nearest plane: 0 for grays, 0.29 for the whole cube."""
    return float(np.linalg.svd(colors - colors.mean(0), compute_uv=False)[-1] / np.sqrt(len(colors)))


def average_repeats(sent: Colors, seen: Colors) -> tuple[Colors, Colors]:
    """Each distinct color sent, with the mean light of how it was seen."""
    colors, index = np.unique(np.asarray(sent, float), axis=0, return_inverse=True)
    light, index = linear_from_srgb(np.asarray(seen, float)), index.reshape(-1)
    total = np.stack([np.bincount(index, light[:, c]) for c in range(3)], 1)
    return colors, srgb_from_linear(total / np.bincount(index)[:, None])


def color_difference(seen: Colors, expected: Colors) -> np.ndarray:
    """ΔE00 N of sRGB colors N×3; values outside of [0, 1] are clipped."""
    return ciede2000(lab_from_srgb(np.clip(seen, 0, 1)), lab_from_srgb(np.clip(expected, 0, 1)))


def fit_white_black(sent: Colors, seen: Colors) -> ColorMap:
    """Fit an affine map in light per channel: white stays, and the darkest color sent becomes the one seen."""
    light, lit = linear_from_srgb(sent), linear_from_srgb(seen)
    dark = light.sum(1).argmin()
    lift = np.clip((lit[dark] - light[dark]) / np.maximum(1 - light[dark], 1e-6), 0, 0.99)
    return lambda colors: srgb_from_linear(lift + (1 - lift) * linear_from_srgb(colors))


def fit_affine(sent: Colors, seen: Colors) -> ColorMap:
    """Fit 12 numbers by least squares in sRGB's code values. In light it was twice as far off (ΔE00 8 instead of 5)."""
    matrix = np.linalg.lstsq(_with_ones(sent), seen, rcond=None)[0]
    return lambda colors: _with_ones(colors) @ matrix


def fit_spline(sent: Colors, seen: Colors) -> ColorMap:
    """Fit a thin-plate spline with an affine part."""
    from scipy.interpolate import RBFInterpolator

    spline = RBFInterpolator(_features(sent), seen, kernel="thin_plate_spline", smoothing=SMOOTHING, degree=1)
    return lambda colors: spline(_features(colors))


def fit_prior_affine(priors: Mapping[str, ColorMap], sent: Colors, seen: Colors) -> ColorMap:
    """Fit an affine map after each prior; the one with the smallest error."""
    fits = {name: fit_affine(prior(sent), seen) for name, prior in priors.items()}
    best = min(fits, key=lambda name: color_difference(fits[name](priors[name](sent)), seen).mean())
    return lambda colors: fits[best](priors[best](colors))


def fit_prior_spline(priors: Mapping[str, ColorMap], sent: Colors, seen: Colors) -> ColorMap:
    """Fit the best prior with its affine map, and a spline to the residuals."""
    start = fit_prior_affine(priors, sent, seen)
    residual_map = fit_spline(sent, seen - start(sent))
    return lambda colors: start(colors) + residual_map(colors)


def _features(colors: Colors) -> np.ndarray:
    return np.hstack([colors, lab_from_srgb(colors) / _LAB_SCALE])


def _with_ones(colors: Colors) -> np.ndarray:
    return np.column_stack([colors, np.ones(len(colors))])


def _held_out(kind: MapKind, sent: Colors, seen: Colors, folds: list[np.ndarray]) -> np.ndarray:
    errors = []
    for fold in folds:
        train = np.setdiff1d(np.arange(len(sent)), fold)
        errors.append(color_difference(kind.fit(sent[train], seen[train])(sent[fold]), seen[fold]))
    return np.concatenate(errors)
