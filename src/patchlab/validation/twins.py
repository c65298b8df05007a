"""Read cells of known color in photographs of prints, and make the twin of each photograph.

In: an NPZ with sRGB sent, light over white paper and each cell's photograph; `photographs.csv` beside it. Out: `Cells`,
and by photograph a `Twin`: a cubic from sRGB sent to sRGB seen through all its cells, and what that leaves of each.
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from itertools import combinations_with_replacement
from pathlib import Path

import numpy as np

from patchlab.validation.known_colors import KnownColors
from patchproof.base.color import srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import read_file
from patchproof.channel.printer import MOTTLE_CELLS


@dataclass(frozen=True)
class Cells:
    """Cells of photographs: N×3 uint8 sRGB sent, N×3 light over paper, each one's photograph; names of photographs."""

    known: KnownColors
    places: tuple[str, ...]
    prints: tuple[str, ...]

    @property
    def twins(self) -> list[Twin]:
        """The twin of each photograph."""
        photos = [self.known.of(np.array([photo])) for photo in range(len(self.places))]
        return [Twin.of(photo.code / 255, srgb_from_linear(photo.light)) for photo in photos]

    def groups(self, left_out: str) -> tuple[str, ...]:
        """The name of the group of each photograph that is left out together."""
        return {"place": self.places, "print": self.prints}.get(left_out, ("",) * len(self.places))


def load_cells(path: Path) -> Cells:
    """Read cells of known color and, beside them, `photographs.csv` with the columns print and place."""
    expected = "cells.npz of photo (N), code (uint8 N×3) and light (N×3, 0 to 4), and a row for each photograph"
    stored, table = io.BytesIO(read_file(path, expected)), path.with_name("photographs.csv")
    rows = list(csv.DictReader(read_file(table, "photographs of known colors").decode("utf-8-sig").splitlines()))
    try:
        with np.load(stored, allow_pickle=False) as file:
            code, light, photo = file["code"], file["light"].astype(float), file["photo"]
        indices, photo = np.unique(photo, return_inverse=True)  # without rows of photographs that have no cell
        # a place of one maker's prints: another's has another phone
        named = [(row["print"], f"{row['print'][:1]} {row['place']}") for row in (rows[i] for i in indices)]
        prints, places = zip(*named, strict=True)
        is_light = 0 <= light.min() <= light.max() <= 4
        if not (is_light and code.dtype == np.uint8 and code.shape == light.shape == (len(photo), 3)):
            raise ValueError("other arrays")
    except Exception as error:  # NumPy, zip and deflate fail in many ways
        got = f"{path} or {table.name} with other contents ({type(error).__name__})"
        raise Refused(expected, got, "write them as patchproof's own are") from error
    return Cells(KnownColors(code, np.clip(light, 0, 1), photo), places, prints)


@dataclass(frozen=True)
class Twin:
    """Colors of one photograph: a polynomial from sRGB sent to sRGB seen, and what it leaves of each cell."""

    degree: int
    factors: np.ndarray
    left: np.ndarray

    @classmethod
    def of(cls, sent: np.ndarray, seen: np.ndarray, degree: int = 3) -> Twin:
        """The least-squares polynomial through the cells N×3 of one photograph; paper is white."""
        white = np.ones((len(sent) // 10, 3))
        terms = _power_terms(np.concatenate([sent, white]), degree)
        factors = np.linalg.lstsq(terms, np.concatenate([seen, white]), rcond=None)[0]
        return cls(degree, factors, seen - _power_terms(sent, degree) @ factors)

    def colors(self, sent: np.ndarray) -> np.ndarray:
        """The colors in place of these, H×W×3 sRGB, without what is left."""
        return (_power_terms(sent.reshape(-1, 3), self.degree) @ self.factors).reshape(sent.shape)

    def show(self, sent: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The piece in these colors, each of its cells with what is left of some cell of the photograph."""
        left = self.left[rng.integers(0, len(self.left), (MOTTLE_CELLS, MOTTLE_CELLS))]
        rows, columns = (np.arange(n) * MOTTLE_CELLS // n for n in sent.shape[:2])
        return np.clip(self.colors(sent) + left[rows][:, columns], 0, 1)


def _power_terms(sent: np.ndarray, degree: int) -> np.ndarray:
    each = (chosen for n in range(degree + 1) for chosen in combinations_with_replacement(range(3), n))
    return np.stack([np.prod(sent[:, list(chosen)], 1) for chosen in each], 1)
