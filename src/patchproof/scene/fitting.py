"""Whether a piece may lie at a place, and how large it may be there.

In: a mesh, a place and the piece that was asked for. Out: the piece as it lies, flat or bent; the largest of the same
shape that lies well there, and the nearest place for the one that was asked for. A piece lies well within the gap and
the overhang that are not warned of. What fits is found by halving: a smaller piece is taken to fit where a larger one
does, which holds but for holes under its middle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.settings import PatchSettings
from patchproof.base.validation import Side
from patchproof.mesh.mesh import Mesh
from patchproof.scene.placement import (
    WARN_OVERHANG_SHARE,
    Placement,
    PlacementMethod,
    SurfaceFrame,
    gap_limit_mm,
    patch_frame,
    side_frame,
)

_STEP_SHARE = 0.25  # of the piece's shorter side between places that are tried
_TRIES_FLAT, _TRIES_BENT = 120, 6  # one takes some 5 and 200 ms
_HALVINGS = 5  # to 3 % of the piece that was asked for


def place_if_close(
    mesh: Mesh,
    frame: SurfaceFrame,
    size_mm: tuple[float, float],
    spin_deg: float,
    lay: PlacementMethod,
    gap_mm: float | None = None,
    overhang_share: float = WARN_OVERHANG_SHARE,
) -> Placement | None:
    """The piece laid down with its middle at the frame's; None where it is refused, stands off farther than `gap_mm`
    (by default what is not warned of) or overhangs by more than a share.
    """
    try:
        laid = lay(mesh, frame, size_mm, spin_deg)
    except Refused:
        return None
    most_mm = gap_limit_mm(size_mm) if gap_mm is None else gap_mm
    return laid if laid.gap_mm <= most_mm and laid.overhang_share <= overhang_share else None


def placement_advice(mesh: Mesh, patch: PatchSettings, lay: PlacementMethod, least_mm: float) -> str:
    """What would lie well instead of a piece that was refused, laid as that was, as the keys of a scene file say it;
    empty where nothing was found. Places are tried on the same side from the nearest on, then in the middles of the
    others.
    """
    frame, size_mm, how = patch_frame(mesh, patch), patch.size_mm, (patch.spin_deg, lay)
    width, height = np.minimum(size_mm, frame.extent_mm).tolist()
    smaller = largest_fitting_size((width, height), lambda trial: place_if_close(mesh, frame, trial, *how), least_mm)
    place = _nearest(mesh, patch, lay)
    found = [f"{smaller[0]:g} × {smaller[1]:g} mm lies well there"] if smaller is not None else []
    found += [f"{size_mm[0]:g} × {size_mm[1]:g} mm lies well with {place}"] if place is not None else []
    return "".join(f"; {text}" for text in found)


def _nearest(mesh: Mesh, patch: PatchSettings, lay: PlacementMethod) -> str | None:
    """The nearest place where the piece lies well, as a scene file's key says it."""

    def fits(frame: SurfaceFrame) -> bool:
        return place_if_close(mesh, frame, patch.size_mm, patch.spin_deg, lay) is not None

    middle = patch_frame(mesh, patch.changed(offset_mm=(0.0, 0.0)))
    step = max(1.0, round(_STEP_SHARE * min(patch.size_mm)))
    (across, along), asked = (int(extent // (2 * step)) for extent in middle.extent_mm), np.array(patch.offset_mm)
    every = [(x * step, y * step) for x in range(-across, across + 1) for y in range(-along, along + 1)]
    every.sort(key=lambda offset: (float(np.hypot(*(offset - asked))), offset))
    for x, y in every[: _TRIES_BENT if patch.bend else _TRIES_FLAT]:
        if fits(replace(middle, origin_mm=middle.origin_mm + x * middle.right + y * middle.up)):
            return f"offset_mm = [{x:g}, {y:g}]"
    sides = sorted(get_args(Side), key=lambda side: (side == patch.side, side[1] == "y"))  # top and bottom last
    side = next((side for side in sides if fits(side_frame(mesh, side))), None)
    return None if side is None else f'side = "{side}"'


def largest_fitting_size(
    size_mm: tuple[float, float], fits: Callable[[tuple[float, float]], object], least_mm: float
) -> tuple[float, float] | None:
    """The largest piece of this shape that fits, in whole millimeters; None where none of `least_mm` or more does."""
    low, high = least_mm / min(size_mm), 1.0
    if low > 1 or not fits(_scaled(size_mm, low)):
        return None
    if fits(_scaled(size_mm, high)):
        return _scaled(size_mm, high)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if fits(_scaled(size_mm, middle)) else (low, middle)
    return _scaled(size_mm, low)


def _scaled(size_mm: tuple[float, float], scale: float) -> tuple[float, float]:
    width, height = (float(np.floor(side * scale + 1e-6)) for side in size_mm)
    return width, height
