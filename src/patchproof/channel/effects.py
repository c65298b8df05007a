"""What views differ by: four records of drawn values, and one table of the effects that fill them.

Two levels: what is one and the same for all photographs of a session (the print, its paper, the light, the camera and
its lens, the place) and what each photograph has of its own (where the camera stands, its exposure, blur and noise,
where in the place). A session here is what one person does in one go with one print.

A record's fields are arrays of one row per view in physical units; what is not given is off (no blur, white paper), and
a single row stands for all views. `EFFECTS` says of each effect how the scene's settings and numbers in [0, 1) become
its fields; its first field is its strength, and at the record's default the effect is off. `plan` and the ablation
study switch effects off by this table alone.

A new effect takes a range in `settings`, a field and a row here, its formula in `channel` and the place in `render`
that applies it. Its numbers come from a generator of its own, keyed by its name: all others' draws stay as they were.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from patchproof.base.settings import SceneSettings

_LEAST_COSINE = 0.2  # the sun is made five times as strong at most where it has to light the patch alone
# Settings of one number; the range is ± what this makes of it.
_ENDS: dict[str, Callable[[float], float]] = {"view.look_at_jitter": float, "camera.white_balance": np.log1p}

FacingCosine = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""N cosines, 0 from behind, between the patch's normal and directions (azimuths, elevations)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Draws:
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
    """A field that is off at this value, its default in one row."""
    return field(default_factory=lambda: np.array([value]), metadata={"off": value})


@dataclass(frozen=True, eq=False, kw_only=True)
class Pose(Draws):
    """What a view has to be rasterized for: camera, background, and the size of the print. Angles are relative to the
    scene's front, offsets are shares of the object's length.
    """

    azimuth_deg: np.ndarray = off()
    elevation_deg: np.ndarray = off()
    distance_mm: np.ndarray
    roll_deg: np.ndarray = off()
    look_at_offset: np.ndarray = off((0.0, 0.0, 0.0))  # N×3
    background: np.ndarray = off((0.0,) * 5)  # N×5 in [0, 1): which picture, crop size, crop x, crop y, mirrored
    printed_scale: np.ndarray = off(1.0)  # the piece's size over the sheet's own


@dataclass(frozen=True, eq=False, kw_only=True)
class Light(Draws):
    """The light that falls on the object (see `channel.light`)."""

    ambient: np.ndarray = off()
    directional: np.ndarray = off()
    light_azimuth_deg: np.ndarray = off()
    light_elevation_deg: np.ndarray = off()


@dataclass(frozen=True, eq=False, kw_only=True)
class Print(Draws):
    """What one print has that the printer's table does not say (see `channel.printer`)."""

    dot_gain: np.ndarray = off()  # these three as in `channel.printer.vary`
    density: np.ndarray = off()
    black: np.ndarray = off()


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensor(Draws):
    """What camera and file make of the light (see `channel.camera`); lengths at the photograph's full size."""

    exposure_ev: np.ndarray = off()
    white_balance: np.ndarray = off((1.0, 1.0, 1.0))  # N×3 gains of red, green, blue
    blur_px: np.ndarray = off()  # Gaussian sigma
    noise: np.ndarray = off()  # standard deviation at white, in linear light
    noise_seed: np.ndarray = off(0)  # int64
    jpeg: np.ndarray = off(0)  # quality; 0: no JPEG, of all views or none
    motion_px: np.ndarray = off()
    motion_deg: np.ndarray = off()  # in [0, 180), counter-clockwise from the picture's x


RECORDS: dict[str, type[Draws]] = {"pose": Pose, "light": Light, "print": Print, "sensor": Sensor}
RECORD_OF = {part.name: record for record, kind in RECORDS.items() for part in fields(kind)}


@dataclass(frozen=True)
class ViewEffect:
    """One thing that views differ by. `columns` are the numbers it takes, each with its range or the setting
    "table.name" that has it; they fill the fields of the same names, or are `made` into the fields `into`. `first` is
    where they stand in the draws that the oldest effects share; some of those draws are nobody's.

    `anew` are the columns that every photograph has of its own ("all", or by name); the others are drawn once a
    session. `switch` is False of what no picture can be without. `instead` makes the light that stands in for a light
    left out.
    """

    name: str
    columns: Mapping[str, str | tuple[float, float]]
    first: int | None = None
    into: tuple[str, ...] = ()
    made: Callable[..., np.ndarray | tuple[np.ndarray, ...]] = lambda *columns: columns
    anew: tuple[str, ...] | Literal["all"] = ()
    switch: bool = True
    instead: Callable[[Any, FacingCosine], Draws] | None = None
    whole: bool = False  # whether it takes whole photographs to be seen as it is

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields it fills; the first is its strength."""
        return self.into or tuple(self.columns)

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings it reads; the first turns it on and off."""
        return tuple(source for source in self.columns.values() if isinstance(source, str))

    def range(self, settings: SceneSettings, column: str) -> tuple[float, float]:
        """The (low, high) of one of its columns."""
        source = self.columns[column]
        if isinstance(source, tuple):
            return source
        table, name = source.split(".")
        value = getattr(getattr(settings, table), name)
        if source not in _ENDS:
            return value
        end = _ENDS[source](value)
        return -end, end

    def sample(self, settings: SceneSettings, unit: np.ndarray, number: np.ndarray) -> dict[str, np.ndarray]:
        """Its fields for N views with numbers N×columns in [0, 1); without columns, the views' own `number` N."""
        ends = (self.range(settings, name) for name in self.columns)
        columns = [low + (high - low) * column for (low, high), column in zip(ends, unit.T, strict=True)]
        values = self.made(*columns) if columns else number
        return dict(zip(self.fields, values if isinstance(values, tuple) else (values,), strict=True))

    def off(self, record: Draws, facing: FacingCosine) -> Draws | None:
        """The record without the effect; None where it is off in all views."""
        strength = self.fields[0]
        drawn, at_rest = getattr(record, strength), record.__dataclass_fields__[strength].metadata["off"]
        if (drawn == at_rest).all():
            return None
        if self.instead is not None:
            return self.instead(record, facing)
        return replace(record, **{strength: np.full_like(drawn, at_rest)})


def _view(azimuth, elevation, distance, roll, *offset: np.ndarray) -> tuple[np.ndarray, ...]:
    return azimuth, elevation, distance, roll, np.column_stack(offset)


def _gains(red: np.ndarray, blue: np.ndarray) -> np.ndarray:
    return np.exp(np.stack([red, np.zeros_like(red), blue], 1))


def _even_for_sun(light: Light, facing: FacingCosine) -> Light:
    """As much even light as the sun gives to the middle of the patch."""
    on_patch = light.directional * facing(light.light_azimuth_deg, light.light_elevation_deg)
    return replace(light, ambient=light.ambient + on_patch, directional=np.zeros_like(on_patch))


def _sun_alone(light: Light, facing: FacingCosine) -> Light:
    """As strong on the patch as ambient light and sun were."""
    cosine = facing(light.light_azimuth_deg, light.light_elevation_deg)
    sun = (light.ambient + light.directional * cosine) / np.maximum(cosine, _LEAST_COSINE)
    return replace(light, ambient=np.zeros_like(light.ambient), directional=sun)


_VIEW = {name: f"view.{name}" for name in ("azimuth_deg", "elevation_deg", "distance_mm", "roll_deg")}
_PLACE: dict[str, tuple[float, float]] = dict.fromkeys(("picture", "size", "x", "y", "mirrored"), (0.0, 1.0))
_JITTER = dict.fromkeys("xyz", "view.look_at_jitter")
_BALANCE: dict[str, str] = dict.fromkeys(("red", "blue"), "camera.white_balance")
_SUN = {"light_azimuth_deg": "light.azimuth_deg", "light_elevation_deg": "light.elevation_deg"}

EFFECTS: tuple[ViewEffect, ...] = (
    ViewEffect("viewpoint", _VIEW | _JITTER, 0, (*_VIEW, "look_at_offset"), _view, anew="all", switch=False),
    ViewEffect("background", _PLACE, 11, ("background",), lambda *place: np.column_stack(place), ("x", "y"), False),
    ViewEffect("directional light", {"directional": "light.directional"} | _SUN, 8, instead=_even_for_sun),
    ViewEffect("ambient light", {"ambient": "light.ambient"}, 7, instead=_sun_alone),
    ViewEffect("dot gain", {"dot_gain": "printer.dot_gain"}, 22),
    ViewEffect("ink density", {"density": "printer.density"}, 23),
    ViewEffect("printed black", {"black": "printer.black"}, 24),
    ViewEffect("print scale", {"printed_scale": "printer.scale"}, 48),
    ViewEffect("exposure", {"exposure_ev": "camera.exposure_ev"}, 16, anew="all"),
    ViewEffect("white balance", _BALANCE, 17, ("white_balance",), _gains),
    ViewEffect(
        "motion blur", {"motion_px": "camera.motion_px", "motion_deg": (0.0, 180.0)}, 40, anew="all", whole=True
    ),
    ViewEffect("blur", {"blur_px": "camera.blur_px"}, 19, anew="all", whole=True),
    ViewEffect("noise", {"noise": "camera.noise"}, 20, anew="all", whole=True),
    ViewEffect("grain", {}, 25, ("noise_seed",), switch=False),
    ViewEffect("JPEG", {"jpeg": "camera.jpeg"}, 21, made=lambda quality: quality.round().astype(np.int64), whole=True),
)
EFFECT_BY_NAME = {effect.name: effect for effect in EFFECTS}

# Fields in the order in which files have them: as they were drawn when all effects shared one sequence.
_DRAWN = sorted(EFFECTS, key=lambda effect: (np.inf if effect.first is None else effect.first, len(effect.columns)))
FIELDS = tuple(name for effect in _DRAWN for name in effect.fields)
