"""Conditions: draws from a scene's ranges of pose, light, background, print and camera (expectation over
transformation).

In: the scene's settings and a stream. Out: `Conditions`, the four records of `channel.effects`. Five streams share
nothing: those for training, selection, the promise, reprints and evaluation. Training and selection use scrambled Sobol
points, which cover the ranges with fewer views; the others draw independently, so that their intervals hold. All follow
from one seed, and a view's draw depends on its index alone (and on the number of photographs in a session): step 70
sees the same views after a resume.

Source of EoT: Athalye et al., Synthesizing Robust Adversarial Examples, ICML 2018.
"""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from patchproof.base.settings import SceneSettings
from patchproof.channel import effects
from patchproof.channel.effects import RECORD_OF, RECORDS, Draws, FacingCosine, Light, Pose, Print, Sensor, ViewEffect

Stream = Literal["train", "select", "promise", "reprint", "evaluate"]
_STREAMS = ("train", "select", "promise", "reprint", "evaluate")
_SOBOL = {"train", "select"}
# Effects with a `first` share the columns of the stream's sequence and, after them, columns of independent numbers.
_DIMENSIONS = 43
_PRINT_DIMENSIONS = 6


@dataclass(frozen=True, eq=False, kw_only=True)
class Conditions(Draws):
    """N draws of everything by which views differ; a record that is not given is off."""

    pose: Pose
    light: Light = field(default_factory=Light)
    print: Print = field(default_factory=Print)
    sensor: Sensor = field(default_factory=Sensor)


def draw(
    settings: SceneSettings, stream: Stream, n: int, seed: int, start: int = 0, per_session: int = 1, salt: str = ""
) -> Conditions:
    """Return draws `start` to `start + n` of a stream, `per_session` in a row for one session; `salt` changes them."""
    return conditions_from_fields(sample_fields(effects.EFFECTS, settings, stream, n, seed, start, per_session, salt))


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
    """Return the effects' fields of draws `start` to `start + n`; no effect's draws depend on other effects."""
    number, stop = _STREAMS.index(stream), start + n
    key = (seed, number, zlib.crc32(salt.encode())) if salt else (seed, number)
    if stream in _SOBOL:
        sequence = scrambled_sobol(stop, np.random.default_rng(key).spawn(1)[0])
    else:
        sequence = np.random.default_rng(key).random((stop, _DIMENSIONS))
    shared_columns = np.concatenate([sequence, np.random.default_rng((*key, 1)).random((stop, _PRINT_DIMENSIONS))], 1)
    # each view has its own noise, the same in every batch
    noise_seeds = ((seed * len(_STREAMS) + number) * 1_000_003 + start + np.arange(n)).astype(np.int64)
    # all photographs of a session share the draw of its first
    session_start = np.arange(start, stop) // per_session * per_session
    values = {}
    for effect in effects:
        count = len(effect.columns)
        if effect.first is None:
            unit = np.random.default_rng((*key, zlib.crc32(effect.name.encode()))).random((stop, count))
        else:
            unit = shared_columns[:, effect.first : effect.first + count]
        shared_by_session = [effect.per_photo != "all" and name not in effect.per_photo for name in effect.columns]
        values |= effect.sample(settings, np.where(shared_by_session, unit[session_start], unit[start:]), noise_seeds)
    return values


def scrambled_sobol(count: int, rng: np.random.Generator) -> np.ndarray:
    """The first `count` points (count×43) of Sobol's sequence, scrambled by random lower triangular matrices and a
    shift: those of scipy.stats.qmc, whose import takes longer than a preview's pictures.
    """
    from torch.quasirandom import SobolEngine

    directions = SobolEngine(_DIMENSIONS).sobolstate.numpy()  # Joe and Kuo's (2008), as in SciPy
    bits = directions.shape[1]
    weights = 1 << np.arange(bits)
    shift = rng.integers(2, size=(_DIMENSIONS, bits), dtype=np.uint32) @ weights
    lower = np.tril(rng.integers(2, size=(_DIMENSIONS, bits, bits), dtype=np.uint32), -1) + np.eye(bits, dtype=int)
    columns = directions[..., None] >> np.arange(bits)[::-1] & 1
    directions = (columns @ lower.swapaxes(1, 2) & 1) @ weights[::-1]
    lowest_zeros = [(~i & i + 1).bit_length() - 1 for i in range(count - 1)]  # by which successive points differ
    return np.bitwise_xor.accumulate(np.concatenate([shift[None], directions[:, lowest_zeros].T])) / 2**bits


def fields_of(conditions: Conditions) -> dict[str, np.ndarray]:
    """Return all records' fields by name, in the order that files have."""
    return {name: getattr(getattr(conditions, RECORD_OF[name]), name) for name in effects.FIELDS}


def conditions_from_fields(values: Mapping[str, np.ndarray]) -> Conditions:
    """Return the conditions with these fields, each in its record."""
    fields: dict[str, Any] = {record: {} for record in RECORDS}
    for name, value in values.items():
        fields[RECORD_OF[name]][name] = value
    records: dict[str, Any] = {record: kind(**fields[record]) for record, kind in RECORDS.items()}
    return Conditions(**records)


def with_values(conditions: Conditions, **values: ArrayLike) -> Conditions:
    """Return `conditions` with some fields set to values (one for all draws, or one per draw)."""
    fields = fields_of(conditions)
    for name, value in values.items():
        old = fields[name]
        fields[name] = np.broadcast_to(np.asarray(value, old.dtype), old.shape).copy()
    return conditions_from_fields(fields)


def without_effect(conditions: Conditions, effect: ViewEffect, facing: FacingCosine) -> Conditions | None:
    """Return `conditions` with the effect off in all views; None if it is off already."""
    name = RECORD_OF[effect.fields[0]]
    record = effect.switch_off(getattr(conditions, name), facing)
    return None if record is None else replace(conditions, **{name: record})
