"""Separate a printer's inks from the light and camera of the photographs that show its known colors.

In: cells of known color in photographs of several places, N×3 sRGB sent and N×3 light over white paper. Out: one map
from the color sent to the light of the ink, as a printer, too; and the light that default conditions make of a printer
for one photograph at best. Place and camera make veil, gains, tone and chroma of that light, by the channel's own
formulas. The map is a quadratic in sRGB's code values after a known printer, which takes colors that were never printed
from that printer.

Ink and photographs are told apart only as far as photographs differ: what all of them share (one phone's tone curve, a
veil that is in every place) is in the map. Photographs of one place share their veil's color but not its strength, for
the angle to the lamp changes it. Left out on purpose: light that changes within a photograph.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor
from torch.nn.functional import pad

from patchproof.base.color import ciede2000, lab_from_linear, lift_tone, linear_from_srgb, srgb_from_linear
from patchproof.base.settings import CameraSettings, PrinterSettings
from patchproof.calibrate.chart import printer_of
from patchproof.channel.effects import tone_by_channel
from patchproof.channel.printer import Printer, printer_output, vary_print

_CENTER = (-0.075, 0.025, 0.025, 0.025, *[0.0] * 6)  # of the terms in the default conditions
_CENTERED = 100.0  # of the mean terms' squared distance from there: what all photographs share is in the ink
_RIDGE = 0.05  # of the photographs' terms, per squared unit: keeps what cells cannot tell near its default
_LOG_GAIN = (-1.0, 1.0)
_STEPS = 150
_ROBUST_DELTA_E = 1.0  # CIELAB distances below count by their square


@dataclass(frozen=True)
class KnownColors:
    """Light of cells of known color: N×3 uint8 sRGB sent, N×3 light over paper, and each cell's photograph."""

    code: np.ndarray
    light: np.ndarray
    photo: np.ndarray

    def of(self, photos: np.ndarray) -> KnownColors:
        """The cells of some photographs."""
        keep = np.isin(self.photo, photos)
        return KnownColors(self.code[keep], self.light[keep], self.photo[keep])


def ink_terms(printed: Tensor) -> Tensor:
    """Return N×10: the quadratic's terms of sRGB values N×3."""
    r, g, b = printed.unbind(1)
    return torch.stack([torch.ones_like(r), r, g, b, r * r, g * g, b * b, r * g, r * b, g * b], 1)


def ink_light(printed: Tensor, ink: Tensor) -> Tensor:
    """Return the light N×3 of the ink over paper; `printed` is the sRGB that the known printer shows."""
    return linear_from_srgb((ink_terms(printed) @ ink).clamp(0, 1))


def photo_light(light: Tensor, terms: Tensor) -> Tensor:
    """Return the light N×3 that photographs show; `terms` N×12: dot gain, density, chroma; veil, log gains, tones."""
    seen = vary_print(light, terms[:, :6]) * terms[:, 6:9].exp()
    return linear_from_srgb(lift_tone(srgb_from_linear(seen.clamp(1e-6, 1)), terms[:, 9:]))


def fit_printer(cells: KnownColors, start: Printer) -> Printer:
    """Fit the ink's quadratic 10×3 after `start`, with the terms of every photograph; white is the printer's paper."""
    photos, index = np.unique(cells.photo, return_inverse=True)
    printed, seen = _printed(cells.code, start), _tensor(cells.light).clamp(0, 1)
    ink, terms = torch.zeros(10, 3, dtype=torch.float64), torch.zeros(len(photos), len(_CENTER), dtype=torch.float64)
    ink[1:4] = torch.eye(3)
    ink.requires_grad_()
    terms.requires_grad_()
    rows, center = torch.tensor(index), torch.tensor(_CENTER, dtype=torch.float64)
    search = torch.optim.LBFGS([ink, terms], max_iter=_STEPS, history_size=20, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        search.zero_grad()
        light = photo_light(ink_light(printed, ink), pad(terms.index_select(0, rows), (2, 0)))
        apart = lab_from_linear(light.clamp(1e-6, 1)) - lab_from_linear(seen)
        value = ((apart**2).sum(1) + _ROBUST_DELTA_E**2).sqrt().mean()
        value += _RIDGE * (terms**2).sum() + _CENTERED * ((terms.mean(0) - center) ** 2).sum()
        value.backward()
        return value

    search.step(loss)
    light = lambda colors: srgb_from_linear(ink_light(_printed(255 * colors, start), ink.detach())).numpy()  # noqa: E731
    return printer_of("left-out", light, {"source": "a study"})


def fit_photo(cells: KnownColors, printer: Printer) -> np.ndarray:
    """Return the light N×3 that default conditions make of a printer where its median cell is nearest to the
    photograph's in ΔE00. How the light of paper was read, a gain for each channel, is free.
    """
    light, lab = linear_from_srgb(_printed(cells.code, printer)), lab_from_linear(cells.light)
    table, tones = PrinterSettings(), [CameraSettings().tone] * 4
    bounds = [table.dot_gain, table.density, table.chroma, *[table.veil] * 3, *[_LOG_GAIN] * 3, *tones]
    low, high = np.array(bounds, float).T

    def shown(terms: np.ndarray) -> np.ndarray:
        drawn = np.concatenate([terms[:9], tone_by_channel(*terms[9:, None])[0]])
        return photo_light(light, _tensor(drawn).expand(len(light), len(drawn))).numpy()

    def distances(terms: np.ndarray) -> np.ndarray:
        return ciede2000(lab_from_linear(shown(terms)), lab)

    terms = minimize(lambda terms: distances(terms).mean(), (low + high) / 2, bounds=bounds).x
    for share in (0.3, 0.1):  # the median has no slope to follow, and a simplex of one size gets stuck
        corners = np.clip(terms + np.vstack([0 * low, np.diag(share * (high - low) / 2)]), low, high)
        simplex = {"method": "Nelder-Mead", "options": {"initial_simplex": corners}}
        terms = minimize(lambda terms: np.median(distances(terms)), terms, bounds=bounds, **simplex).x
    return shown(terms)


def _printed(code: np.ndarray, printer: Printer) -> Tensor:
    return _tensor(printer_output(printer, code / 255))


def _tensor(values: np.ndarray) -> Tensor:
    return torch.as_tensor(np.asarray(values, float))
