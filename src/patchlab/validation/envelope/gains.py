"""Where a design stops gaining: beside its controls, point by point of a sweep.

In: what worked of the design and of each control on the same conditions, points × conditions. Out: per point the gain
over the best control, with its paired interval; and where it ends. A rate alone says little: a network may answer the
target's label of pure noise, and then so it does of the bare object. What gains nothing at a point has no effect there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from patchlab.validation.envelope.fit import BEYOND_SWEEP, Break
from patchproof.base.intervals import Estimate, paired_difference

CONTROLS = ("bare", "gray")  # of the promise's the bare object and the markers alone; a noise design needs its own draw


def gains_over_controls(design: np.ndarray, controls: Mapping[str, np.ndarray]) -> list[Estimate]:
    """Per point the rate of `design` P×N minus that of the control, each P×N, that is hardest to beat there."""
    gains = []
    for point, own in enumerate(design):
        best = max((worked[point] for worked in controls.values()), key=np.sum)
        value, (low, high) = paired_difference(own.tolist(), best.tolist())
        gains.append(Estimate(value, low, high, len(own)))
    return gains


def has_effect(gain: Estimate) -> bool:
    """Whether the design gains: the interval lies above 0."""
    return gain.low > 0


def gain_break(gains: Sequence[Estimate], at: np.ndarray) -> Break:
    """Between the last point (positions P in [0, 1]) of those from the easy end on at which the design gains, and the
    first at which it does not; `rates` are the gains at both ends.
    """
    ends, lost = (gains[0].value, gains[-1].value), [i for i, gain in enumerate(gains) if not has_effect(gain)]
    if not lost:
        return Break(BEYOND_SWEEP, BEYOND_SWEEP, BEYOND_SWEEP, None, ends)
    if lost[0] == 0:
        return Break(None, None, None, None, ends)
    low, high = float(at[lost[0] - 1]), float(at[lost[0]])
    return Break((low + high) / 2, low, high, None, ends)
