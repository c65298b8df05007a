"""Gains of a design over its controls at each point of a sweep, and where they end.

In: hits of the design and of each control under the same conditions, points × conditions. Out: per point the gain over
the best control with its paired interval, and the point where gains end. A rate alone tells little, since a network may
give the target's label to pure noise, and then also to the bare object. Without a gain a design has no effect.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from patchlab.validation.envelope.fit import BEYOND_SWEEP, Break
from patchproof.base.intervals import Estimate, paired_difference

CONTROLS = ("bare", "gray")  # of a promise's controls; a noise design would need a draw


def gains_over_controls(design: np.ndarray, controls: Mapping[str, np.ndarray]) -> list[Estimate]:
    """Per point the rate of `design` P×N minus that of the best control there, each P×N."""
    gains = []
    for point, hits in enumerate(design):
        best = max((worked[point] for worked in controls.values()), key=np.sum)
        value, (low, high) = paired_difference(hits.tolist(), best.tolist())
        gains.append(Estimate(value, low, high, len(hits)))
    return gains


def has_effect(gain: Estimate) -> bool:
    """True if the gain's interval lies above 0."""
    return gain.low > 0


def gain_break(gains: Sequence[Estimate], positions: np.ndarray) -> Break:
    """The break between the first point without a gain and the one before it, positions P in [0, 1] from easy to hard;
    `rates` are the gains at both ends.
    """
    ends, lost = (gains[0].value, gains[-1].value), [i for i, gain in enumerate(gains) if not has_effect(gain)]
    if not lost:
        return Break(BEYOND_SWEEP, BEYOND_SWEEP, BEYOND_SWEEP, None, ends)
    if lost[0] == 0:
        return Break(None, None, None, None, ends)
    low, high = float(positions[lost[0] - 1]), float(positions[lost[0]])
    return Break((low + high) / 2, low, high, None, ends)
