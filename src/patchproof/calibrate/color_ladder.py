"""Maps from colors to colors, from none to free, and the choice among them by colors that they did not see.

In: N×3 sRGB colors sent and seen, and known printers as priors. Out: `MapChoice`: the map, and every rung's figure. Each
map is tried on colors that it was not fitted to (ten folds; the corners of the RGB cube always stay in training, since
a color outside of those seen is a guess), and `ladder` chooses by ΔE00. Too few colors to hold any out, or colors that
are all nearly gray, leave only maps with nothing to fit, or paper and black: held-out grays tell nothing of others.

The splines see each color as sRGB and as CIELAB together: drivers work in either, and in one of them a printer is close
to straight. With 48 swatches that took ΔE00 3.2 to 2.3 where the driver looks for nearest colors, and cost 0.2 where it
only mixes inks.

Source: Duchon, Splines minimizing rotation-invariant semi-norms in Sobolev spaces, 1977.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from patchproof.base.color import ciede2000, lab_from_srgb, linear_from_srgb, srgb_from_linear
from patchproof.calibrate.ladder import Rung, compare_rungs, simplest_rung

Colors = np.ndarray  # N×3 sRGB in [0, 1]
ColorMap = Callable[[Colors], Colors]

FOLDS = 10
LEAST_HELD_OUT = 6  # with fewer, a mean says nothing of a rung
# Rms distance of the colors from their flattest plane; charts have 0.30 and more. With the chart's colors drawn towards
# gray, held-out errors said 1.0 to 1.5 where others were off by up to 3 at 0.13, 4 at 0.06, 14 at 0.03, 35 at 0.001.
WELL_SPREAD_WIDTH, FLAT = 0.15, 0.05
SMOOTHING = 1e-3  # of splines: from 1e-4 to 1e-2 held-out errors differ by less than 0.05
_LAB_SCALE = 60.0  # CIELAB units that count as much as the whole range of one sRGB channel


@dataclass(frozen=True)
class MapKind:
    """A kind of map: how to fit it, and the fewest distinct colors that takes."""

    name: str
    fit: Callable[[Colors, Colors], ColorMap]
    least: int
    endpoints: bool = False  # nothing is fitted, or paper and black only


@dataclass(frozen=True)
class MapChoice:
    """The kind of map that was chosen, fitted to all colors; `rungs` in ΔE00 of all that were tried, simplest first."""

    chosen: Rung
    predict: ColorMap
    rungs: tuple[Rung, ...]
    seconds: dict[str, float]  # of one fit
    colors: int
    held_out: int
    left_out: tuple[str, ...]  # kinds that would have needed more colors, or more colorful ones
    width: float  # of the colors: rms distance from their flattest plane


def map_kinds(priors: Mapping[str, ColorMap]) -> tuple[MapKind, ...]:
    """All kinds, simplest first; those of priors are left out where there are none."""
    free = (
        MapKind("identity", lambda sent, shown: lambda colors: colors, 0, True),
        MapKind("white_black", fit_white_black, 2, True),
        MapKind("affine", fit_affine, 12),
    )
    known = (
        MapKind("prior", partial(_best, priors), 0, True),
        MapKind("prior+affine", partial(fit_prior_affine, priors), 12),
        MapKind("prior+affine+spline", partial(fit_prior_spline, priors), 24),
    )
    return free + (known if priors else ()) + (MapKind("spline", fit_spline, 24),)


def choose(kinds: Sequence[MapKind], sent: Colors, shown: Colors) -> MapChoice:
    """The simplest kind that is no worse than the best; colors sent twice are averaged first."""
    sent, shown = distinct(sent, shown)
    corners, width = np.isin(sent, (0.0, 1.0)).all(1), color_width(sent)
    tried = [kind for kind in kinds if len(sent) >= kind.least and (kind.endpoints or width >= FLAT)]
    folds = _folds(np.flatnonzero(~corners))
    if (~corners).sum() < LEAST_HELD_OUT:
        ends = (sent == 1).all(1) | (sent.sum(1) == sent.sum(1).min())
        tried, folds = [kind for kind in tried if kind.endpoints], [np.flatnonzero(~ends if not ends.all() else ends)]
    names = [kind.name for kind in tried]
    errors, seconds = zip(*(_held_out(kind, sent, shown, folds) for kind in tried), strict=True)
    rungs = compare_rungs(names, np.array(errors))
    chosen = simplest_rung(rungs)
    left_out = tuple(kind.name for kind in kinds if kind not in tried)
    fitted, times = tried[chosen].fit(sent, shown), dict(zip(names, seconds, strict=True))
    return MapChoice(rungs[chosen], fitted, rungs, times, len(sent), len(errors[0]), left_out, width)


def color_width(colors: Colors) -> float:
    """Rms distance of N×3 colors from the plane that they lie nearest to: 0 of grays, 0.29 of the whole cube."""
    return float(np.linalg.svd(colors - colors.mean(0), compute_uv=False)[-1] / np.sqrt(len(colors)))


def distinct(sent: Colors, shown: Colors) -> tuple[Colors, Colors]:
    """Each color sent once, with the mean light of how it was shown."""
    colors, index = np.unique(np.asarray(sent, float), axis=0, return_inverse=True)
    light, index = linear_from_srgb(np.asarray(shown, float)), index.reshape(-1)
    total = np.stack([np.bincount(index, light[:, c]) for c in range(3)], 1)
    return colors, srgb_from_linear(total / np.bincount(index)[:, None])


def difference(shown: Colors, expected: Colors) -> np.ndarray:
    """ΔE00 N of sRGB colors; what lies outside of [0, 1] counts as clipped."""
    return ciede2000(lab_from_srgb(np.clip(shown, 0, 1)), lab_from_srgb(np.clip(expected, 0, 1)))


def fit_white_black(sent: Colors, shown: Colors) -> ColorMap:
    """Per channel an affine map in light: white stays, and the darkest color sent becomes the one shown."""
    light, lit = linear_from_srgb(sent), linear_from_srgb(shown)
    dark = light.sum(1).argmin()
    lift = np.clip((lit[dark] - light[dark]) / np.maximum(1 - light[dark], 1e-6), 0, 0.99)
    return lambda colors: srgb_from_linear(lift + (1 - lift) * linear_from_srgb(colors))


def fit_affine(sent: Colors, shown: Colors) -> ColorMap:
    """Least squares in sRGB's code values: 12 numbers. In light it was twice as far off (ΔE00 8 instead of 5)."""
    matrix = np.linalg.lstsq(_with_ones(sent), shown, rcond=None)[0]
    return lambda colors: _with_ones(colors) @ matrix


def fit_spline(sent: Colors, shown: Colors) -> ColorMap:
    """A thin-plate spline with an affine part."""
    from scipy.interpolate import RBFInterpolator

    spline = RBFInterpolator(_features(sent), shown, kernel="thin_plate_spline", smoothing=SMOOTHING, degree=1)
    return lambda colors: spline(_features(colors))


def fit_prior_affine(priors: Mapping[str, ColorMap], sent: Colors, shown: Colors) -> ColorMap:
    """An affine map after the prior for which that leaves least."""
    fits = {name: fit_affine(prior(sent), shown) for name, prior in priors.items()}
    best = min(fits, key=lambda name: difference(fits[name](priors[name](sent)), shown).mean())
    return lambda colors: fits[best](priors[best](colors))


def fit_prior_spline(priors: Mapping[str, ColorMap], sent: Colors, shown: Colors) -> ColorMap:
    """The corrected prior, and a spline of what it leaves."""
    start = fit_prior_affine(priors, sent, shown)
    rest = fit_spline(sent, shown - start(sent))
    return lambda colors: start(colors) + rest(colors)


def _best(priors: Mapping[str, ColorMap], sent: Colors, shown: Colors) -> ColorMap:
    """The prior that shows these colors best."""
    return min(priors.values(), key=lambda prior: difference(prior(sent), shown).mean())


def _features(colors: Colors) -> np.ndarray:
    return np.hstack([colors, lab_from_srgb(colors) / _LAB_SCALE])


def _with_ones(colors: Colors) -> np.ndarray:
    return np.column_stack([colors, np.ones(len(colors))])


def _folds(held_out: np.ndarray) -> list[np.ndarray]:
    """Indices of up to ten folds, mixed by a fixed seed."""
    mixed = np.random.default_rng(0).permutation(held_out)
    return [fold for fold in np.array_split(mixed, FOLDS) if len(fold)]


def _held_out(kind: MapKind, sent: Colors, shown: Colors, folds: list[np.ndarray]) -> tuple[np.ndarray, float]:
    """ΔE00 of each held-out color, fold by fold, and the mean seconds of a fit."""
    errors, begin = [], time.perf_counter()
    for fold in folds:
        train = np.setdiff1d(np.arange(len(sent)), fold)
        errors.append(difference(kind.fit(sent[train], shown[train])(sent[fold]), shown[fold]))
    return np.concatenate(errors), (time.perf_counter() - begin) / len(folds)
