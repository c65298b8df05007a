"""How an effect is stated: the numbers that it takes, the settings that give their ranges, and what they fill.

In: for N views, as many numbers in [0, 1) as an effect has columns. Out: fields of a record of `Rows`. The records and
the table of all effects are in `effects`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from typing_extensions import Self

from patchproof.settings import SceneSettings


@dataclass(frozen=True, eq=False, kw_only=True)
class Rows:
    """N draws: every field has N rows. A field of one row is repeated; other numbers of rows are a ValueError."""

    def __post_init__(self):
        counts = {len(values) for values in vars(self).values()} - {1}
        if len(counts) > 1:
            raise ValueError(f"fields of one record have {sorted(counts)} rows")
        every = np.zeros(counts.pop() if counts else 1, int)
        for name, values in vars(self).items():
            if len(values) != len(every):
                object.__setattr__(self, name, values[every])

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, rows: slice | np.ndarray | list[int]) -> Self:
        """The draws at a slice or index array."""
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})


def off(value: Any = 0.0) -> Any:
    """A field whose default, in one row, is this value."""
    return field(default_factory=lambda: np.array([value]))


def default_of(kind: type[Rows], name: str) -> np.ndarray:
    """The value with which a field of a record is off."""
    (factory,) = (part.default_factory for part in fields(kind) if part.name == name)
    return factory()[0]  # pyright: ignore[reportCallIssue]  (the stubs do not tell fields with a default apart)


Facing = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""N cosines, 0 from behind, between the patch's normal and directions (azimuths, elevations)."""


@dataclass(frozen=True)
class Setting:
    """A key "table.name" of the scene's settings whose value stands for a range."""

    key: str
    ends: Callable[[Any], tuple[float, float]]


@dataclass(frozen=True)
class Effect:
    """One thing that views differ by. `columns` are the numbers it takes, each with its range or the setting's key that
    has it; they fill the fields of the same names, or are `made` into the fields `into`. `first` is where they stand in
    the draws that the oldest effects share.

    `switch` is False of what no picture can be without. `instead` makes the light that stands in for a light left out.
    """

    name: str
    columns: Mapping[str, str | Setting | tuple[float, float]]
    first: int | None = None
    into: tuple[str, ...] = ()
    made: Callable[..., tuple[np.ndarray, ...]] = lambda *columns: columns
    switch: bool = True
    instead: Callable[[Any, Facing], Rows] | None = None
    slows: bool = False  # whether a step takes longer with it
    whole: bool = False  # whether it takes whole photographs to be seen as it is
    only_paper: bool = False  # whether nothing but paper shows it

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields it fills; the first is its strength."""
        return self.into or tuple(self.columns)

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings it reads; the first turns it on and off."""
        sources = (source.key if isinstance(source, Setting) else source for source in self.columns.values())
        return tuple(source for source in sources if isinstance(source, str))

    def range(self, settings: SceneSettings, column: str) -> tuple[float, float]:
        """The (low, high) of one of its columns."""
        source = self.columns[column]
        if isinstance(source, tuple):
            return source
        key, ends = (source.key, source.ends) if isinstance(source, Setting) else (source, tuple)
        table, name = key.split(".")
        low, high = ends(getattr(getattr(settings, table), name))
        return low, high

    def sample(self, settings: SceneSettings, unit: np.ndarray, number: np.ndarray) -> dict[str, np.ndarray]:
        """Its fields for N views with numbers N×columns in [0, 1); without columns, the views' own `number` N."""
        ends = (self.range(settings, name) for name in self.columns)
        columns = [low + (high - low) * column for (low, high), column in zip(ends, unit.T, strict=True)]
        return dict(zip(self.fields, self.made(*columns) if columns else (number,), strict=True))

    def off(self, record: Rows, facing: Facing) -> Rows | None:
        """The record without the effect; None where it is off in all views."""
        strength = self.fields[0]
        drawn, default = getattr(record, strength), default_of(type(record), strength)
        if (drawn == default).all():
            return None
        if self.instead is not None:
            return self.instead(record, facing)
        return replace(record, **{strength: np.full_like(drawn, default)})
