"""Conditions: draws from a scene's ranges of pose, light, background, print and camera (expectation over
transformation).

In: the scene's settings and a stream. Out: `Conditions`, the four records of `channel.effects`. Five streams share
nothing: what trains, what selects, what is promised, what is reprinted and what is evaluated. Training and selection
use scrambled Sobol points, which cover the ranges with fewer views; the others draw independently, so that their
intervals hold. All follow from one seed, and a view's draw depends on its index alone (and on how many make
a session): step 70 sees the same views after a resume.

Source of EoT: Athalye et al., Synthesizing Robust Adversarial Examples, ICML 2018.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from patchproof.base.settings import SceneSettings
from patchproof.channel.effects import (
    EFFECTS,
    FIELDS,
    RECORD_OF,
    RECORDS,
    Effect,
    Facing,
    Light,
    Pose,
    Print,
    Rows,
    Sensor,
)

Stream = Literal["train", "select", "promise", "reprint", "evaluate"]
_STREAMS = ("train", "select", "promise", "reprint", "evaluate")
_SOBOL = {"train", "select"}
# The oldest effects share a sequence of the stream's own kind and, after it, one of independent numbers.
_DIMENSIONS = 43
_PRINT_DIMENSIONS = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions(Rows):
    """N draws of everything that views differ by; what is not given is off."""

    pose: Pose
    light: Light = field(default_factory=Light)
    print: Print = field(default_factory=Print)
    sensor: Sensor = field(default_factory=Sensor)


def draw(
    settings: SceneSettings,
    stream: Stream,
    n: int,
    seed: int,
    start: int = 0,
    per_session: int = 1,
    salt: str = "",
) -> Conditions:
    """Draws `start` to `start + n` of a stream; `per_session` in a row, from the first of all, are one session. Another
    `salt`, other draws.
    """
    return of_fields(sampled(EFFECTS, settings, stream, n, seed, start, per_session, salt))


def sampled(
    effects: Sequence[Effect],
    settings: SceneSettings,
    stream: Stream,
    n: int,
    seed: int,
    start: int,
    per_session: int = 1,
    salt: str = "",
) -> dict[str, np.ndarray]:
    """The fields that effects fill in draws `start` to `start + n`; no effect's draws depend on the others."""
    number, end = _STREAMS.index(stream), start + n
    key = (seed, number, zlib.crc32(salt.encode())) if salt else (seed, number)
    sequence = _unit(stream, _rng(*key), end)
    shared = np.concatenate([sequence, _rng(*key, 1).random((end, _PRINT_DIMENSIONS))], 1)
    # each view's noise is its own, whatever batch it is rendered in
    views = ((seed * len(_STREAMS) + number) * 1_000_003 + start + np.arange(n)).astype(np.int64)
    # what a session's photographs share is what was drawn for its first
    first = np.arange(start, end) // per_session * per_session
    values = {}
    for effect in effects:
        count = len(effect.columns)
        if effect.first is None:
            unit = _rng(*key, zlib.crc32(effect.name.encode())).random((end, count))
        else:
            unit = shared[:, effect.first : effect.first + count]
        values |= effect.sample(settings, np.where(effect.shared, unit[first], unit[start:]), views)
    return values


def fields_of(conditions: Conditions) -> dict[str, np.ndarray]:
    """All records' fields by name, in the order in which files have them."""
    return {name: getattr(getattr(conditions, RECORD_OF[name]), name) for name in FIELDS}


def of_fields(values: Mapping[str, np.ndarray]) -> Conditions:
    """The conditions with these fields, in whatever records they are."""
    records: dict[str, Any] = {
        record: kind(**{name: value for name, value in values.items() if RECORD_OF[name] == record})
        for record, kind in RECORDS.items()
    }
    return Conditions(**records)


def with_values(conditions: Conditions, **values: ArrayLike) -> Conditions:
    """`conditions` with some fields set to values (one for all draws, or one per draw) and all others as drawn."""
    fields = fields_of(conditions)
    for name, value in values.items():
        drawn = fields[name]
        fields[name] = np.broadcast_to(np.asarray(value, drawn.dtype), drawn.shape).copy()
    return of_fields(fields)


def with_poses_of(conditions: Conditions, poses: Conditions) -> Conditions:
    """`conditions` seen from the cameras and before the backgrounds of `poses`, row by row.

    What was rasterized for `poses` serves for the result, too: light, print and camera need no rasterizing.
    """
    if len(conditions) != len(poses):
        raise ValueError(f"{len(conditions)} conditions cannot take the poses of {len(poses)}")
    return replace(conditions, pose=poses.pose)


def without(conditions: Conditions, effect: Effect, facing: Facing) -> Conditions | None:
    """`conditions` with the effect off in all views; None where it is off already."""
    name = RECORD_OF[effect.fields[0]]
    record = effect.off(getattr(conditions, name), facing)
    return None if record is None else replace(conditions, **{name: record})


def _rng(*key: int) -> np.random.Generator:
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(key)))


def _unit(stream: Stream, rng: np.random.Generator, n: int) -> np.ndarray:
    """n×D points of the unit cube; the first k do not depend on n."""
    if stream not in _SOBOL:
        return rng.random((n, _DIMENSIONS))
    from scipy.stats import qmc

    return qmc.Sobol(_DIMENSIONS, rng=rng).random_base2(max(n - 1, 1).bit_length())[:n]
