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
    Draws,
    FacingCosine,
    Light,
    Pose,
    Print,
    Sensor,
    ViewEffect,
)

Stream = Literal["train", "select", "promise", "reprint", "evaluate"]
_STREAMS = ("train", "select", "promise", "reprint", "evaluate")
_SOBOL = {"train", "select"}
# The oldest effects share a sequence of the stream's own kind and, after it, one of independent numbers.
_DIMENSIONS = 43
_PRINT_DIMENSIONS = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions(Draws):
    """N draws of everything that views differ by; what is not given is off."""

    pose: Pose
    light: Light = field(default_factory=Light)
    print: Print = field(default_factory=Print)
    sensor: Sensor = field(default_factory=Sensor)


def draw(
    settings: SceneSettings, stream: Stream, n: int, seed: int, start: int = 0, per_session: int = 1, salt: str = ""
) -> Conditions:
    """Draws `start` to `start + n` of a stream; `per_session` in a row are one session; another `salt`, other draws."""
    return conditions_from_fields(sample_fields(EFFECTS, settings, stream, n, seed, start, per_session, salt))


def sample_fields(
    effects: Sequence[ViewEffect],
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
    if stream in _SOBOL:
        from scipy.stats import qmc

        # the first points do not depend on how many there are
        points = qmc.Sobol(_DIMENSIONS, rng=np.random.default_rng(key)).random_base2(max(end - 1, 1).bit_length())
        sequence = points[:end]
    else:
        sequence = np.random.default_rng(key).random((end, _DIMENSIONS))
    shared = np.concatenate([sequence, np.random.default_rng((*key, 1)).random((end, _PRINT_DIMENSIONS))], 1)
    # each view's noise is its own, whatever batch it is rendered in
    views = ((seed * len(_STREAMS) + number) * 1_000_003 + start + np.arange(n)).astype(np.int64)
    # what a session's photographs share is what was drawn for its first
    first = np.arange(start, end) // per_session * per_session
    values = {}
    for effect in effects:
        count = len(effect.columns)
        if effect.first is None:
            unit = np.random.default_rng((*key, zlib.crc32(effect.name.encode()))).random((end, count))
        else:
            unit = shared[:, effect.first : effect.first + count]
        shared_by_session = [effect.anew != "all" and name not in effect.anew for name in effect.columns]
        values |= effect.sample(settings, np.where(shared_by_session, unit[first], unit[start:]), views)
    return values


def fields_of(conditions: Conditions) -> dict[str, np.ndarray]:
    """All records' fields by name, in the order in which files have them."""
    return {name: getattr(getattr(conditions, RECORD_OF[name]), name) for name in FIELDS}


def conditions_from_fields(values: Mapping[str, np.ndarray]) -> Conditions:
    """The conditions with these fields, in whatever records they are."""
    fields: dict[str, Any] = {record: {} for record in RECORDS}
    for name, value in values.items():
        fields[RECORD_OF[name]][name] = value
    made: dict[str, Any] = {record: kind(**fields[record]) for record, kind in RECORDS.items()}
    return Conditions(**made)


def with_values(conditions: Conditions, **values: ArrayLike) -> Conditions:
    """`conditions` with some fields set to values (one for all draws, or one per draw) and all others as drawn."""
    fields = fields_of(conditions)
    for name, value in values.items():
        drawn = fields[name]
        fields[name] = np.broadcast_to(np.asarray(value, drawn.dtype), drawn.shape).copy()
    return conditions_from_fields(fields)


def without_effect(conditions: Conditions, effect: ViewEffect, facing: FacingCosine) -> Conditions | None:
    """`conditions` with the effect off in all views; None where it is off already."""
    name = RECORD_OF[effect.fields[0]]
    record = effect.off(getattr(conditions, name), facing)
    return None if record is None else replace(conditions, **{name: record})
