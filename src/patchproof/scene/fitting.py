"""Find out if a piece may lie at a place, and how large it may be there.

In: a mesh, a place and the piece that is wanted. Out: the piece's placement, flat or bent; the largest piece of the
same shape that lies well there, and the nearest place for the wanted size. A piece lies well if its gap and its
overhang are below those that give a warning. The largest size is found by bisection, on the assumption that a smaller
piece fits where a larger one does, which only holes under its middle contradict.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import get_args

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.settings import PatchSettings
from patchproof.base.validation import Side
from patchproof.mesh.mesh import Mesh
from patchproof.scene import placement
from patchproof.scene.placement import Placement, PlacementMethod, SurfaceFrame, patch_frame, side_frame

_STEP_SHARE = 0.25  # of the piece's shorter side between places that are tried
_TRIES_FLAT, _TRIES_BENT = 120, 6  # one takes about 5 and 200 ms
_HALVINGS = 5  # to 3 % of the wanted piece


def place_if_close(
    mesh: Mesh,
    frame: SurfaceFrame,
    size_mm: tuple[float, float],
    spin_deg: float,
    lay: PlacementMethod,
    gap_mm: float | None = None,
) -> Placement | None:
    """Place the piece with its middle at the frame's origin. None if that is refused, if the piece stands off farther
    than `gap_mm` (by default the limit of the warning), or if it overhangs by more than the limit of the warning.
    """
    try:
        piece = lay(mesh, frame, size_mm, spin_deg)
    except Refused:
        return None
    limit_mm = placement.gap_limit_mm(size_mm) if gap_mm is None else gap_mm
    return piece if piece.gap_mm <= limit_mm and piece.overhang_share <= placement.WARN_OVERHANG_SHARE else None


def placement_advice(mesh: Mesh, patch: PatchSettings, lay: PlacementMethod, least_mm: float) -> str:
    """Suggest, as keys of a scene file, sizes and places at which a refused piece would lie well; empty if none was
    found. Places are tried on the same side from the nearest on, then in the middles of the other sides.
    """
    frame, size_mm = patch_frame(mesh, patch), patch.size_mm
    width, height = np.minimum(size_mm, frame.extent_mm).tolist()
    fits = partial(place_if_close, mesh, frame, spin_deg=patch.spin_deg, lay=lay)
    smaller = largest_fitting_size((width, height), fits, least_mm)
    place = _nearest_place(mesh, patch, lay)
    suggestions = [f"{smaller[0]:g} × {smaller[1]:g} mm lies well there"] if smaller is not None else []
    suggestions += [f"{size_mm[0]:g} × {size_mm[1]:g} mm lies well with {place}"] if place is not None else []
    return "".join(f"; {text}" for text in suggestions)


def _nearest_place(mesh: Mesh, patch: PatchSettings, lay: PlacementMethod) -> str | None:
    """Return the nearest place where the piece lies well, as a key of a scene file."""
    fits = partial(place_if_close, mesh, size_mm=patch.size_mm, spin_deg=patch.spin_deg, lay=lay)
    middle = patch_frame(mesh, patch.changed(offset_mm=(0.0, 0.0)))
    step = max(1.0, round(_STEP_SHARE * min(patch.size_mm)))
    (across, along), wanted_mm = (int(extent // (2 * step)) for extent in middle.extent_mm), np.array(patch.offset_mm)
    offsets = [(x * step, y * step) for x in range(-across, across + 1) for y in range(-along, along + 1)]
    offsets.sort(key=lambda offset: (float(np.hypot(*(offset - wanted_mm))), offset))
    for x, y in offsets[: _TRIES_BENT if patch.bend else _TRIES_FLAT]:
        if fits(replace(middle, origin_mm=middle.origin_mm + x * middle.right + y * middle.up)):
            return f"offset_mm = [{x:g}, {y:g}]"
    sides = sorted(get_args(Side), key=lambda side: (side == patch.side, side[1] == "y"))  # top and bottom last
    side = next((side for side in sides if fits(side_frame(mesh, side))), None)
    return None if side is None else f'side = "{side}"'


def largest_fitting_size(
    size_mm: tuple[float, float], fits: Callable[[tuple[float, float]], object], least_mm: float
) -> tuple[float, float] | None:
    """Return the largest piece of this shape that fits, in whole millimeters; None if `least_mm` does not."""
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
