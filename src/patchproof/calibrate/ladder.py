"""Choose from a ladder of models the simplest one whose held-out error is no worse than the best one's.

In: each model's error on every item while that item was held out, simplest model first. No worse means within one
standard error (Breiman's rule), and that is the standard error of the *paired* difference from the best, item by item:
items that are hard for every model say nothing about which one is better.

Sources: Breiman, Friedman, Olshen, Stone, Classification and Regression Trees, 1984, 3.4.3 (the rule of one standard
error); Hastie, Tibshirani, Friedman, The Elements of Statistical Learning, 2nd ed., 7.10 (cross-validation).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Rung:
    """A model's mean held-out error, its difference from the best model's error, and the standard error of that
    difference; infinite where there was no fit.
    """

    name: str
    error: float
    worse_by: float
    standard_error: float


def choose_rung(names: Sequence[str], errors: np.ndarray) -> tuple[int, tuple[Rung, ...]]:
    """The number of the rung to use, and all, of errors models × items; rows that are not finite had no fit, but not
    all.
    """
    means = np.where(np.isfinite(errors).all(1), errors.mean(1), np.inf)
    worse = errors[np.isfinite(means)] - errors[means.argmin()]
    by, spread = np.full((2, len(means)), np.inf)
    by[np.isfinite(means)] = worse.mean(1)
    spread[np.isfinite(means)] = worse.std(1, ddof=1) / np.sqrt(worse.shape[1]) if worse.shape[1] > 1 else 0.0
    rungs = tuple(map(Rung, names, means.tolist(), by.tolist(), spread.tolist()))
    return int(np.argmax(np.isfinite(means) & (by <= spread))), rungs
