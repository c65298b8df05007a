"""What views differ by: four records of drawn values, and one table of the effects that fill them.

A record's fields are arrays of one row per view in physical units; what is not given is off (no blur, white paper), and
a single row stands for all views. `EFFECTS` says of each effect how the scene's settings and numbers in [0, 1) become
its fields; its first field is its strength, and at the record's default the effect is off. `plan` and the ablation
study switch effects off by this table alone.

A new effect takes a range in `settings`, a field and a row here, its formula in `channel` and the place in `render`
that applies it. Its numbers come from a generator of its own, keyed by its name: all others' draws stay as they were.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from patchproof.channel.effect import Effect, Facing, Rows, Setting, off
from patchproof.color import tinted_white

# The sun and lamps stand within these angles of the patch's side: from behind, nothing on the patch could be seen.
_AZIMUTH_DEG, _ELEVATION_DEG = (-90.0, 90.0), (10.0, 80.0)
_UNIT = (0.0, 1.0)
# Normal coefficients come from the middle of the unit interval: 3.1 standard deviations at most, never infinity.
_NORMAL_MARGIN = 1e-3
_LEAST_COSINE = 0.2  # the sun is made five times as strong at most where it has to light the patch alone


@dataclass(frozen=True, eq=False, kw_only=True)
class Pose(Rows):
    """What a view has to be rasterized for: camera, background, and the size of the print. Angles are relative to the
    patch's side, offsets are shares of the object's length.
    """

    azimuth_deg: np.ndarray = off()
    elevation_deg: np.ndarray = off()
    distance_mm: np.ndarray
    roll_deg: np.ndarray = off()
    look_at_offset: np.ndarray = off((0.0, 0.0, 0.0))  # N×3
    background: np.ndarray = off((0.0,) * 5)  # N×5 in [0, 1): which picture, crop size, crop x, crop y, mirrored
    printed_scale: np.ndarray = off(1.0)  # the piece's size over the sheet's own


@dataclass(frozen=True, eq=False, kw_only=True)
class Light(Rows):
    """The light that falls on the object, and what glossy paper makes of it (see `channel.light`)."""

    ambient: np.ndarray = off()
    directional: np.ndarray = off()
    light_azimuth_deg: np.ndarray = off()
    light_elevation_deg: np.ndarray = off()
    point: np.ndarray = off()  # a lamp's light on the patch's middle where it faces the lamp
    point_azimuth_deg: np.ndarray = off()
    point_elevation_deg: np.ndarray = off()
    point_distance_mm: np.ndarray = off(1.0)  # from the patch's middle
    sh2: np.ndarray = off()  # standard deviation of the ambient light over directions, share of its mean
    sh2_coefficients: np.ndarray = off((0.0,) * 8)  # N×8 standard normal, as `channel.light` orders them
    gloss: np.ndarray = off()
    shininess: np.ndarray = off(1.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class Print(Rows):
    """What one print has that the printer's table does not say (see `channel.printer`)."""

    dot_gain: np.ndarray = off()  # these three as in `channel.printer.vary`
    density: np.ndarray = off()
    black: np.ndarray = off()
    paper: np.ndarray = off((1.0, 1.0, 1.0))  # N×3 light of bare paper, beside the sheet that the light is measured by
    misregistration_mm: np.ndarray = off(((0.0, 0.0), (0.0, 0.0)))  # N×2×2: red's and blue's shift, right and down


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensor(Rows):
    """What camera and file make of the light (see `channel.camera`); lengths at the photograph's full size."""

    exposure_ev: np.ndarray = off()
    white_balance: np.ndarray = off((1.0, 1.0, 1.0))  # N×3 gains of red, green, blue
    blur_px: np.ndarray = off()  # Gaussian sigma
    noise: np.ndarray = off()  # standard deviation at white, in linear light
    noise_seed: np.ndarray = off(0)  # int64
    jpeg: np.ndarray = off(0)  # quality; 0: no JPEG, of all views or none
    motion_px: np.ndarray = off()
    motion_deg: np.ndarray = off()  # in [0, 180), counter-clockwise from the picture's x
    vignetting: np.ndarray = off()  # share of the light lost in the photograph's corners


RECORDS: dict[str, type[Rows]] = {"pose": Pose, "light": Light, "print": Print, "sensor": Sensor}
RECORD_OF = {part.name: record for record, kind in RECORDS.items() for part in fields(kind)}


def _stacked(*columns: np.ndarray) -> tuple[np.ndarray]:
    return (np.stack(columns, 1),)


def _view(azimuth, elevation, distance, roll, *offset: np.ndarray) -> tuple[np.ndarray, ...]:
    return azimuth, elevation, distance, roll, np.stack(offset, 1)


def _uneven(sh2: np.ndarray, *coefficients: np.ndarray) -> tuple[np.ndarray, ...]:
    from scipy.special import ndtri

    return sh2, ndtri(_NORMAL_MARGIN + (1 - 2 * _NORMAL_MARGIN) * np.stack(coefficients, 1))


def _white(light: np.ndarray, b: np.ndarray) -> tuple[np.ndarray]:
    return (tinted_white(light, b),)


def _shifts(length_mm: np.ndarray, *turns: np.ndarray) -> tuple[np.ndarray]:
    """Both planes as far, each in its own direction."""
    angles = np.stack(turns, 1) * 2 * np.pi
    return (length_mm[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], -1),)


def _gains(red: np.ndarray, blue: np.ndarray) -> tuple[np.ndarray]:
    return (np.exp(np.stack([red, np.zeros_like(red), blue], 1)),)


def _whole(quality: np.ndarray) -> tuple[np.ndarray]:
    return (np.round(quality).astype(np.int64),)


def _even_for_sun(light: Light, facing: Facing) -> Light:
    cosine = facing(light.light_azimuth_deg, light.light_elevation_deg)
    return _evenly(light, "directional", light.directional * cosine)


def _even_for_lamp(light: Light, facing: Facing) -> Light:
    return _evenly(light, "point", light.point * facing(light.point_azimuth_deg, light.point_elevation_deg))


def _evenly(light: Light, source: str, on_patch: np.ndarray) -> Light:
    """What a source gives to the middle of the patch given by even light; the uneven part of that stays."""
    ambient = light.ambient + on_patch
    sh2 = light.sh2 * light.ambient / np.maximum(ambient, 1e-9)
    return replace(light, ambient=ambient, sh2=sh2, **{source: np.zeros_like(on_patch)})


def _sun_alone(light: Light, facing: Facing) -> Light:
    """As strong on the patch as ambient light and sun were."""
    cosine = facing(light.light_azimuth_deg, light.light_elevation_deg)
    sun = (light.ambient + light.directional * cosine) / np.maximum(cosine, _LEAST_COSINE)
    return replace(light, ambient=np.zeros_like(light.ambient), directional=sun)


def _units(*names: str) -> dict[str, tuple[float, float]]:
    return dict.fromkeys(names, _UNIT)


_VIEW = {name: f"view.{name}" for name in ("azimuth_deg", "elevation_deg", "distance_mm", "roll_deg")}
_JITTER = Setting("view.look_at_jitter", lambda share: (-share, share))
_BALANCE = Setting("camera.white_balance", lambda share: (-np.log1p(share), np.log1p(share)))
_SUN = {"light_azimuth_deg": _AZIMUTH_DEG, "light_elevation_deg": _ELEVATION_DEG}
_LAMP = {"point_azimuth_deg": _AZIMUTH_DEG, "point_elevation_deg": _ELEVATION_DEG}
_LAMP_MM = {"point_distance_mm": "light.point_distance_mm"}
_SHIFT = {"length": "printer.misregistration_mm"} | _units("red", "blue")
_SH2 = {"sh2": "light.sh2"} | _units(*(f"coefficient {i}" for i in range(8)))

EFFECTS: tuple[Effect, ...] = (
    Effect("viewpoint", _VIEW | dict.fromkeys("xyz", _JITTER), 0, (*_VIEW, "look_at_offset"), _view, switch=False),
    Effect("background", _units("picture", "size", "x", "y", "mirrored"), 11, ("background",), _stacked, switch=False),
    Effect("directional light", {"directional": "light.directional"} | _SUN, 8, instead=_even_for_sun),
    Effect("ambient light", {"ambient": "light.ambient"}, 7, instead=_sun_alone),
    Effect("lamp", {"point": "light.point"} | _LAMP | _LAMP_MM, 25, instead=_even_for_lamp, slows=True),
    Effect("uneven ambient", _SH2, 29, ("sh2", "sh2_coefficients"), _uneven, slows=True),
    Effect("gloss", {"gloss": "light.gloss", "shininess": "light.shininess"}, 38, slows=True, only_paper=True),
    Effect("dot gain", {"dot_gain": "printer.dot_gain"}, 22),
    Effect("ink density", {"density": "printer.density"}, 23),
    Effect("printed black", {"black": "printer.black"}, 24),
    Effect("paper white", {"light": "printer.paper_white", "b": "printer.paper_b"}, 43, ("paper",), _white),
    Effect("misregistration", _SHIFT, 45, ("misregistration_mm",), _shifts, slows=True),
    Effect("print scale", {"printed_scale": "printer.scale"}, 48),
    Effect("exposure", {"exposure_ev": "camera.exposure_ev"}, 16),
    Effect("white balance", {"red": _BALANCE, "blue": _BALANCE}, 17, ("white_balance",), _gains),
    Effect("vignetting", {"vignetting": "camera.vignetting"}, 42, slows=True),
    Effect("motion blur", {"motion_px": "camera.motion_px", "motion_deg": (0.0, 180.0)}, 40, slows=True, whole=True),
    Effect("blur", {"blur_px": "camera.blur_px"}, 19, slows=True, whole=True),
    Effect("noise", {"noise": "camera.noise"}, 20, slows=True, whole=True),
    Effect("grain", {}, 25, ("noise_seed",), switch=False),
    Effect("JPEG", {"jpeg": "camera.jpeg"}, 21, ("jpeg",), _whole, slows=True, whole=True),
)
EFFECT = {effect.name: effect for effect in EFFECTS}


def _place(effect: Effect) -> tuple[float, int]:
    return np.inf if effect.first is None else effect.first, len(effect.columns)


# Fields in the order in which files have them: as they were drawn when all effects shared one sequence.
FIELDS = tuple(name for effect in sorted(EFFECTS, key=_place) for name in effect.fields)
