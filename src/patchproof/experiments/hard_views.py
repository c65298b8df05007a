"""Mining: train more where the clean object fails.

In: a problem and how many tries to make. Out: the conditions of all training steps. Before the first step the
clean object is shown under that many draws, forward only, and its loss is fitted by pose and light: a ridge regression
on each of their values and its square (of azimuths, sines and cosines of once and twice the angle). Every other
training view then takes pose and light from the one of `CANDIDATES` fresh draws that the fit expects to be the worst.
The rest stays as drawn, so that what is easy is not forgotten.

Taking the worst tries themselves, over and over, did harm: a box whose top is misread was recognized in 59 % of such
views without mining, in 46 % with the four worst of 32 poses in every other view. A fit names as many poses as there
are views, and it needs no averaging over backgrounds.

What is hard depends on the scene and its seed alone, never on the design: a run that was stopped mines the same views
when it goes on. Trying hard views anew in each step (online hard example mining: Shrivastava et al., CVPR 2016) would
follow the design, but it costs passes in every step. Poses that fail: Alcorn et al., Strike (with) a Pose, CVPR 2019.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from patchproof.channel.effects import EFFECT
from patchproof.experiments.stress_map import clean
from patchproof.optimizer.problem import Problem
from patchproof.scene.conditions import Conditions, fields_of, of_fields, with_values

# What of a draw is the pose and the light; the rest is background, print and camera.
POSE = EFFECT["viewpoint"].fields
_LIGHT = ("ambient light", "directional light", "exposure", "lamp", "uneven ambient")
LIGHT = tuple(name for effect in _LIGHT for name in EFFECT[effect].fields)
CANDIDATES = 8
_RIDGE = 1.0  # beside features of unit variance: as much as one try


def training_conditions(problem: Problem, tries: int) -> Conditions:
    """The conditions of all steps, `views` rows each, mined by `tries` of the clean object."""
    settings = problem.scene.settings.optimize
    count = settings.steps * settings.views
    candidates = count // 2 * CANDIDATES
    drawn = problem.scene.draw("train", count + tries + candidates)
    tried, others = drawn[count : count + tries], drawn[count + tries :]
    tried, others = (part[problem.scene.facing(part)] for part in (tried, others))  # behind it no patch can help
    if len(tried) < 2 or len(others) < CANDIDATES:
        return drawn[:count]
    expected = expected_losses(tried, clean(problem, tried, problem.training_px).loss.mean(0), others)
    return with_pose_and_light(drawn[:count], others[hardest(expected)])


def each_before_all(tried: Conditions, rest: Conditions, names: Sequence[str] = POSE + LIGHT) -> Conditions:
    """The fields `names` of each row of `tried`, with all else from each row of `rest`: row by row of `tried`."""
    rows = np.tile(np.arange(len(rest)), len(tried))
    fields = fields_of(tried)
    return with_values(rest[rows], **{name: fields[name].repeat(len(rest), 0) for name in names})


def expected_losses(tried: Conditions, losses: np.ndarray, others: Conditions) -> np.ndarray:
    """The losses that pose and light of `others` let expect, by the fit to those of `tried`."""
    known = _features(tried)
    middle, spread = known.mean(0), known.std(0)
    varies = spread > 1e-9
    known, asked = (((x - middle) / np.where(varies, spread, 1))[:, varies] for x in (known, _features(others)))
    weights = np.linalg.solve(known.T @ known + _RIDGE * np.eye(known.shape[1]), known.T @ (losses - losses.mean()))
    return losses.mean() + asked @ weights


def hardest(expected: np.ndarray) -> np.ndarray:
    """Of every `CANDIDATES` rows the index of the one of which the most loss is expected."""
    groups = expected[: len(expected) // CANDIDATES * CANDIDATES].reshape(-1, CANDIDATES)
    return groups.argmax(1) + CANDIDATES * np.arange(len(groups))


def with_pose_and_light(conditions: Conditions, hard: Conditions) -> Conditions:
    """`conditions`, every other row with pose and light of the next row of `hard`, over and over."""
    rows = np.arange(1, len(conditions), 2)
    source = (rows // 2) % len(hard)
    changed, fields = fields_of(conditions), fields_of(hard)
    for name in POSE + LIGHT:
        changed[name] = changed[name].copy()
        changed[name][rows] = fields[name][source]
    return of_fields(changed)


def _features(conditions: Conditions) -> np.ndarray:
    """N×F: what the loss is fitted by."""
    columns, fields = [], fields_of(conditions)
    for name in POSE + LIGHT:
        for values in fields[name].reshape(len(conditions), -1).T:
            if name.endswith("azimuth_deg"):
                angle = np.radians(values)
                columns += [np.cos(angle), np.sin(angle), np.cos(2 * angle), np.sin(2 * angle)]
            else:
                columns += [values, values**2]
    return np.stack(columns, 1)
