"""The effects by which views differ: four records of drawn values, and one table of the effects that fill them.

Print, paper, light, camera, lens and place are the same for all photographs of a session, which is what one person does
in one go with one print; each photograph has its own camera position, exposure, blur, noise, and position within the
place.

A record's fields are arrays of one row per view in physical units. A field that is not given is off (no blur, white
paper), and a single row stands for all views. `EFFECTS` says for each effect how the scene's settings and numbers in
[0, 1) become its fields; its first field is its strength, and at the record's default the effect is off. `plan` and the
ablation study switch effects off by this table alone.

A new effect takes a range in `settings`, a field and a row here, its formula in `channel`, and the place in `render`
that applies it. Its generator is keyed by its name, so that other effects' draws do not change.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, Self

import numpy as np

from patchproof.base.color import MAX_TONE
from patchproof.base.settings import SceneSettings
from patchproof.base.text import short_repr

_MIN_COSINE = 0.2  # a sun that has to light the patch alone becomes at most five times as strong
# For settings of one number the range is ± the result of this function.
_HALF_RANGE: dict[str, Callable[[float], float]] = {"view.look_at_jitter": float, "camera.white_balance": np.log1p}
_VEIL_TINT = (-0.34, 0.34)  # logarithm of a veil's red and blue over its green: bluish by a window, reddish by wood

FacingCosine = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Returns N cosines between the patch's normal and directions (azimuths, elevations); 0 from behind."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Draws:
    """N draws: every field has N rows. A field of one row is repeated; any other mixture of lengths is a ValueError."""

    __repr__ = short_repr

    def __init_subclass__(cls):
        cls.__repr__ = short_repr  # a dataclass would list all rows

    def __post_init__(self):
        counts = {len(values) for values in vars(self).values()} - {1}
        if len(counts) > 1:
            raise ValueError(f"fields of one record have {sorted(counts)} rows")
        repeats = np.zeros(counts.pop() if counts else 1, int)
        for name, values in vars(self).items():
            if len(values) != len(repeats):
                object.__setattr__(self, name, values[repeats])

    def __len__(self) -> int:
        return len(next(iter(vars(self).values())))

    def __getitem__(self, rows: slice | np.ndarray | list[int]) -> Self:
        """Return the draws at a slice or index array."""
        return replace(self, **{name: values[rows] for name, values in vars(self).items()})


def off(value: Any = 0.0) -> Any:
    """Declare a field whose default, in one row, is the value at which its effect is off."""
    return field(default_factory=lambda: np.array([value]), metadata={"off": value})


@dataclass(frozen=True, eq=False, kw_only=True)
class Pose(Draws):
    """The values for which a view must be rasterized again: camera, background, and the size of the print. Angles are
    relative to the scene's front, offsets are shares of the object's length.
    """

    azimuth_deg: np.ndarray = off()
    elevation_deg: np.ndarray = off()
    distance_mm: np.ndarray
    roll_deg: np.ndarray = off()
    look_at_offset: np.ndarray = off((0.0, 0.0, 0.0))  # N×3
    background: np.ndarray = off((0.0,) * 5)  # N×5 in [0, 1): picture, crop size, crop x, crop y, mirroring
    printed_scale: np.ndarray = off(1.0)  # the printed piece's size divided by the sheet's


@dataclass(frozen=True, eq=False, kw_only=True)
class Light(Draws):
    """The light that falls on the object (see `channel.camera`)."""

    ambient: np.ndarray = off()
    directional: np.ndarray = off()
    light_azimuth_deg: np.ndarray = off()
    light_elevation_deg: np.ndarray = off()


@dataclass(frozen=True, eq=False, kw_only=True)
class Print(Draws):
    """Deviations of one print, as a photograph shows it, from the printer's table (`channel.printer.vary_print`)."""

    dot_gain: np.ndarray = off()
    density: np.ndarray = off()
    chroma: np.ndarray = off()
    veil: np.ndarray = off((0.0, 0.0, 0.0))  # N×3 red, green, blue
    mottle: np.ndarray = off()  # rms in sRGB, from cell to cell (see `channel.printer.mottle_cells`)
    mottle_seed: np.ndarray = off(0)  # int64


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensor(Draws):
    """Effects of camera and file on the light (see `channel.camera`); lengths at the photograph's full size."""

    exposure_ev: np.ndarray = off()
    white_balance: np.ndarray = off((1.0, 1.0, 1.0))  # N×3 gains of red, green, blue
    blur_px: np.ndarray = off()  # Gaussian sigma
    noise: np.ndarray = off()  # standard deviation at white, in linear light
    noise_seed: np.ndarray = off(0)  # int64
    tone: np.ndarray = off((0.0, 0.0, 0.0))  # N×3, added to middle gray's code values by a phone's tone mapping
    jpeg: np.ndarray = off(0)  # quality; 0 is no JPEG, for all views or for none
    motion_px: np.ndarray = off()
    motion_deg: np.ndarray = off()  # in [0, 180), counter-clockwise from the picture's x


RECORDS: dict[str, type[Draws]] = {"pose": Pose, "light": Light, "print": Print, "sensor": Sensor}
RECORD_OF = {part.name: record for record, kind in RECORDS.items() for part in fields(kind)}


@dataclass(frozen=True)
class ViewEffect:
    """One effect by which views differ. `columns` are the numbers it draws, each with its range or the setting
    "table.name" that holds it. They fill the fields of the same names, or `transform` turns them into the fields
    `targets`. `first` is their position in the sequence that the oldest effects share; None for an effect with its own
    generator.

    `per_photo` names the columns that are drawn for every photograph (or "all"); others are drawn once a session.
    `can_be_off` is False for an effect that every picture has. `replacement` makes the light that stands in when this
    light is left out. An effect that `needs_whole_photo` cannot be seen in reduced pictures as it is.
    """

    name: str
    columns: Mapping[str, str | tuple[float, float]]
    first: int | None = None
    targets: tuple[str, ...] = ()
    transform: Callable[..., np.ndarray | tuple[np.ndarray, ...]] = lambda *columns: columns
    per_photo: tuple[str, ...] | Literal["all"] = ()
    can_be_off: bool = True
    replacement: Callable[[Any, FacingCosine], Draws] | None = None
    needs_whole_photo: bool = False

    @property
    def fields(self) -> tuple[str, ...]:
        """The fields that the effect fills; the first is its strength."""
        return self.targets or tuple(self.columns)

    @property
    def keys(self) -> tuple[str, ...]:
        """The settings that the effect reads; the first turns it on and off."""
        return tuple(source for source in self.columns.values() if isinstance(source, str))

    def range(self, settings: SceneSettings, column: str) -> tuple[float, float]:
        """Return the (low, high) of one of the effect's columns."""
        source = self.columns[column]
        if isinstance(source, tuple):
            return source
        table, name = source.split(".")
        value = getattr(getattr(settings, table), name)
        if source not in _HALF_RANGE:
            return value
        end = _HALF_RANGE[source](value)
        return -end, end

    def sample(self, settings: SceneSettings, unit: np.ndarray, number: np.ndarray) -> dict[str, np.ndarray]:
        """Return the fields for N views from numbers N×columns in [0, 1); without columns, the views' `number` N."""
        ends = (self.range(settings, name) for name in self.columns)
        columns = [low + (high - low) * column for (low, high), column in zip(ends, unit.T, strict=True)]
        values = self.transform(*columns) if columns else number
        return dict(zip(self.fields, values if isinstance(values, tuple) else (values,), strict=True))

    def switch_off(self, record: Draws, facing: FacingCosine) -> Draws | None:
        """Return the record without the effect; None if the effect is off in all views already."""
        strength = self.fields[0]
        values, off_value = getattr(record, strength), record.__dataclass_fields__[strength].metadata["off"]
        if (values == off_value).all():
            return None
        if self.replacement is not None:
            return self.replacement(record, facing)
        return replace(record, **{strength: np.full_like(values, off_value)})


def _view(azimuth, elevation, distance, roll, *offset: np.ndarray) -> tuple[np.ndarray, ...]:
    return azimuth, elevation, distance, roll, np.column_stack(offset)


def _gains(red: np.ndarray, blue: np.ndarray) -> np.ndarray:
    return np.exp(np.stack([red, np.zeros_like(red), blue], 1))


def tone_by_channel(tone: np.ndarray, *channels: np.ndarray) -> np.ndarray:
    """Return the tones N×3 of red, green and blue: `tone` N, and half of what each of `channels` is off their mean."""
    drawn = np.column_stack(channels)
    return np.clip(tone[:, None] + (drawn - drawn.mean(1, keepdims=True)) / 2, -MAX_TONE, MAX_TONE)


def _even_for_sun(light: Light, facing: FacingCosine) -> Light:
    """Replace the sun by as much ambient light as it gives to the middle of the patch."""
    on_patch = light.directional * facing(light.light_azimuth_deg, light.light_elevation_deg)
    return replace(light, ambient=light.ambient + on_patch, directional=np.zeros_like(on_patch))


def _sun_alone(light: Light, facing: FacingCosine) -> Light:
    """Replace ambient light and sun by a sun that is as strong on the patch as both were."""
    cosine = facing(light.light_azimuth_deg, light.light_elevation_deg)
    sun = (light.ambient + light.directional * cosine) / np.maximum(cosine, _MIN_COSINE)
    return replace(light, ambient=np.zeros_like(light.ambient), directional=sun)


_VIEW = {name: f"view.{name}" for name in ("azimuth_deg", "elevation_deg", "distance_mm", "roll_deg")}
_CROP: dict[str, tuple[float, float]] = dict.fromkeys(("picture", "size", "x", "y", "mirrored"), (0.0, 1.0))
_JITTER = dict.fromkeys("xyz", "view.look_at_jitter")
_BALANCE: dict[str, str] = dict.fromkeys(("red", "blue"), "camera.white_balance")
_VEIL: dict[str, str | tuple[float, float]] = {"strength": "printer.veil", "red": _VEIL_TINT, "blue": _VEIL_TINT}
_MOTTLE: dict[str, str | tuple[float, float]] = {"mottle": "printer.mottle", "seed": (0.0, 2.0**31)}
# the channels' own tones: 29 photographs of four prints differ by ±0.04, places by more than photographs of one
_TONE: dict[str, str | tuple[float, float]] = dict.fromkeys(("tone", "red", "green", "blue"), "camera.tone")
_SUN = {"light_azimuth_deg": "light.azimuth_deg", "light_elevation_deg": "light.elevation_deg"}
_MOTION: dict[str, str | tuple[float, float]] = {"motion_px": "camera.motion_px", "motion_deg": (0.0, 180.0)}

EFFECTS: tuple[ViewEffect, ...] = (
    ViewEffect("viewpoint", _VIEW | _JITTER, 0, (*_VIEW, "look_at_offset"), _view, per_photo="all", can_be_off=False),
    ViewEffect("background", _CROP, 11, ("background",), lambda *crop: np.column_stack(crop), ("x", "y"), False),
    ViewEffect("directional light", {"directional": "light.directional"} | _SUN, 8, replacement=_even_for_sun),
    ViewEffect("ambient light", {"ambient": "light.ambient"}, 7, replacement=_sun_alone),
    ViewEffect("dot gain", {"dot_gain": "printer.dot_gain"}, 22),
    ViewEffect("ink density", {"density": "printer.density"}, 23),
    ViewEffect("veil", _VEIL, None, ("veil",), lambda strength, *tint: strength[:, None] * _gains(*tint)),
    ViewEffect("chroma", {"chroma": "printer.chroma"}, per_photo="all"),
    ViewEffect("mottle", _MOTTLE, None, ("mottle", "mottle_seed"), lambda rms, seed: (rms, seed.astype(np.int64))),
    ViewEffect("print scale", {"printed_scale": "printer.scale"}, 48),
    ViewEffect("exposure", {"exposure_ev": "camera.exposure_ev"}, 16, per_photo="all"),
    ViewEffect("white balance", _BALANCE, 17, ("white_balance",), _gains),
    ViewEffect("tone", _TONE, None, ("tone",), tone_by_channel, ("tone",)),
    ViewEffect("motion blur", _MOTION, 40, per_photo="all", needs_whole_photo=True),
    ViewEffect("blur", {"blur_px": "camera.blur_px"}, 19, per_photo="all", needs_whole_photo=True),
    ViewEffect("noise", {"noise": "camera.noise"}, 20, per_photo="all", needs_whole_photo=True),
    ViewEffect("grain", {}, 25, ("noise_seed",), can_be_off=False),
    ViewEffect("JPEG", {"jpeg": "camera.jpeg"}, 21, (), lambda q: q.round().astype(np.int64), needs_whole_photo=True),
)
EFFECT_BY_NAME = {effect.name: effect for effect in EFFECTS}

# Fields in the order that files have: by `first`, effects with a generator of their own last.
_ORDERED = sorted(EFFECTS, key=lambda effect: (np.inf if effect.first is None else effect.first, len(effect.columns)))
FIELDS = tuple(name for effect in _ORDERED for name in effect.fields)
