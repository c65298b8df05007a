"""Simulated inkjet printers with drawn inks, papers and drivers, to test calibration.

In: a seed. Out: a function from sRGB sent to media-relative linear light, N×3 to N×3. None of them comes from an ICC
profile: dots grow, and the inks' overprints mix by Neugebauer's equations with Yule and Nielsen's exponent, in three
wide bands. The driver sends colors to inks plainly, with more saturation, with black ink in place of gray mixtures, or
it knows its printer and looks for the nearest color that it can print, with or without more saturation; the last two
have kinks at the border of the gamut, as real drivers do. Ranges are wider than those of good printers, since a
calibration should follow any printer.

Sources: Demichel's weights and the Yule-Nielsen modified Neugebauer model as in Hébert and Hersch, Review of spectral
reflectance models for halftone prints, Color Research and Application 40 (2015).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np

from patchproof.base.color import lab_from_linear, lab_from_srgb

DRIVERS = ("plain", "saturated", "black ink", "matching", "saturated matching")
# light that solid cyan, magenta and yellow transmit in red, green and blue; the middle of the drawn range
_INKS = np.array([[0.06, 0.42, 0.72], [0.62, 0.05, 0.22], [0.92, 0.78, 0.07]])
_SOLIDS = np.array(list(product((0, 1), repeat=4)))  # cyan, magenta, yellow, black; slowest first
_TABLE_NODES = np.linspace(0, 1, 17)  # of a matching driver's own table
_AVERAGED_COLORS = 4  # printable colors that a matching driver averages, so that its table is smooth


@dataclass(frozen=True, eq=False)
class Inkjet:
    """Light of the solid overprints 16×3, dot gain of each ink at half tone, Yule and Nielsen's n, the driver, the
    saturation that it adds, and the share of gray that it gives to black ink.
    """

    primaries: np.ndarray
    dot_gain: np.ndarray
    n: float
    driver: str
    saturation: float
    black_share: float

    def __call__(self, srgb: np.ndarray) -> np.ndarray:
        """Print sRGB N×3: linear light N×3 with bare paper at 1."""
        srgb = np.clip(np.asarray(srgb, float), 0, 1)
        if self.driver.endswith("matching"):
            return self._printed(self._table(srgb))
        gray = srgb.mean(-1, keepdims=True)
        return self._printed(1 - np.clip(gray + (1 + self.saturation) * (srgb - gray), 0, 1))

    def _printed(self, ink: np.ndarray) -> np.ndarray:
        """Light of coverages of cyan, magenta and yellow; black ink replaces its share of their gray."""
        black = self.black_share * np.clip(2 * ink.min(-1, keepdims=True) - 1, 0, 1)
        coverage = np.concatenate([ink - 0.8 * black, black], -1)
        coverage = coverage + 4 * self.dot_gain * coverage * (1 - coverage)
        weights = np.where(_SOLIDS, coverage[..., None, :], 1 - coverage[..., None, :]).prod(-1)
        return (weights @ self.primaries ** (1 / self.n)) ** self.n

    @cached_property
    def _table(self):
        """A matching driver's table sRGB → cyan, magenta, yellow: nearest printable colors, by CIELAB."""
        from scipy.interpolate import RegularGridInterpolator
        from scipy.spatial import KDTree

        ink = _grid(np.linspace(0, 1, 33))
        printable = lab_from_linear(self._printed(ink))
        wanted = lab_from_srgb(_grid(_TABLE_NODES))
        darkest = printable[:, 0].min()
        wanted = wanted * [1 - darkest / 100, 1 + self.saturation, 1 + self.saturation] + [darkest, 0, 0]
        distance, index = KDTree(printable).query(wanted, _AVERAGED_COLORS)
        weights = 1 / (distance + 0.1) ** 2
        sent = (ink[index] * weights[..., None]).sum(1) / weights.sum(1, keepdims=True)
        sent[-1] = 0  # no driver prints on white
        return RegularGridInterpolator((_TABLE_NODES,) * 3, sent.reshape(*(len(_TABLE_NODES),) * 3, 3))


def draw_inkjet(seed: int) -> Inkjet:
    """Draw inks, dot gain and paper from their ranges; drivers take turns by seed."""
    rng = np.random.default_rng([seed, 20])
    density = rng.uniform(0.7, 1.15, (3, 1))
    inks = np.clip(_INKS * rng.uniform(0.8, 1.2, (3, 3)), 0.02, 1) ** density
    surface = rng.uniform(0.005, 0.06)  # light from the surface of the paper: plain paper has much of it
    solids = np.concatenate([inks, np.full((1, 3), rng.uniform(0.0, 0.04))])
    trapping = rng.uniform(0.75, 1.0)  # of an ink that falls on another one
    power = np.where(_SOLIDS.sum(1) > 1, trapping, 1.0)[:, None]
    light = np.where(_SOLIDS[..., None], solids, 1.0).prod(1) ** power
    driver = DRIVERS[seed % len(DRIVERS)]
    return Inkjet(
        primaries=surface + (1 - surface) * light,
        dot_gain=rng.uniform(-0.05, 0.2, 4),
        n=float(rng.uniform(1.0, 3.0)),
        driver=driver,
        saturation=float(rng.uniform(0.1, 0.4)) if driver.startswith("saturated") else 0.0,
        black_share=float(rng.uniform(0.4, 1.0)) if driver in ("black ink", "matching") else 0.0,
    )


def _grid(nodes: np.ndarray) -> np.ndarray:
    """All N³ colors N³×3 of N nodes, the last channel fastest."""
    return np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1).reshape(-1, 3)
