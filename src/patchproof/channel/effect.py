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
    """A key "table.name" of the scene's settings, and the ends of the range that its value stands for."""

    key: str
    ends: Callable[[Any], tuple[float, float]] = lambda value: value

    def range(self, settings: SceneSettings) -> tuple[float, float]:
        """(low, high)."""
        table, name = self.key.split(".")
        return self.ends(getattr(getattr(settings, table), name))


@dataclass(frozen=True)
class Effect:
    """One thing that views differ by. `columns` are the numbers it takes and their ranges; they fill the fields of the
    same names, or are `made` into `fields`. `first` is where they stand in the draws that the oldest effects share.

    `switch` is False of what no picture can be without. `instead` makes the light that stands in for a light left out.
    """

    name: str
    columns: Mapping[str, Setting | tuple[float, float]]
    first: int | None = None
    fields: tuple[str, ...] = ()
    made: Callable[..., tuple[np.ndarray, ...]] | None = None
    switch: bool = True
    instead: Callable[[Any, Facing], Rows] | None = None
    slows: bool = False  # whether a step takes longer with it
    whole: bool = False  # whether it takes whole photographs to be seen as it is
    only_paper: bool = False  # whether nothing but paper shows it

    def __post_init__(self):
        if self.made is None:
            object.__setattr__(self, "fields", self.fields or tuple(self.columns))

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings it reads; the first turns it on and off."""
        return tuple(source.key for source in self.columns.values() if isinstance(source, Setting))

    def range(self, settings: SceneSettings, column: str) -> tuple[float, float]:
        """The (low, high) of one of its columns."""
        source = self.columns[column]
        return source.range(settings) if isinstance(source, Setting) else source

    def sample(self, settings: SceneSettings, unit: np.ndarray, number: np.ndarray) -> dict[str, np.ndarray]:
        """Its fields for N views with numbers N×columns in [0, 1); without columns, the views' own `number` N."""
        values = []
        for name, column in zip(self.columns, unit.T, strict=True):
            low, high = self.range(settings, name)
            values.append(low + (high - low) * column)
        if self.made is not None:
            values = self.made(*values)
        return dict(zip(self.fields, values or [number], strict=True))

    def off(self, record: Rows, facing: Facing) -> Rows | None:
        """The record without the effect; None where it is off in all views."""
        strength = self.fields[0]
        drawn, default = getattr(record, strength), default_of(type(record), strength)
        if (drawn == default).all():
            return None
        if self.instead is not None:
            return self.instead(record, facing)
        return replace(record, **{strength: np.full_like(drawn, default)})
