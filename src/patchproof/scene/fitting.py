"""How large a piece may be where it is to hang.

In: a mesh, a place and the piece that was asked for. Out: the largest piece of the same shape that lies there, and
whether a piece lies well: within the gap and the overhang that are not warned of. What fits is found by halving: a
smaller piece is taken to fit where a larger one does, which holds but for holes under its middle.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from patchproof.mesh.mesh import Mesh
from patchproof.scene.bend import place_bent
from patchproof.scene.placement import WARN_GAP_SHARE, WARN_OVERHANG_SHARE, Frame, Placement, place_card
from patchproof.strict import Refused

_HALVINGS = 5  # to 3 % of the piece that was asked for


def lies_well(mesh: Mesh, frame: Frame, size_mm: tuple[float, float], spin_deg: float, bend: bool) -> bool:
    """Whether a piece lies there without a warning."""
    laid = laid_or_none(mesh, frame, size_mm, spin_deg, bend)
    return (
        laid is not None and laid.gap_mm <= WARN_GAP_SHARE * min(size_mm) and laid.overhang_share <= WARN_OVERHANG_SHARE
    )


def laid_or_none(
    mesh: Mesh, frame: Frame, size_mm: tuple[float, float], spin_deg: float, bend: bool
) -> Placement | None:
    """The piece there; None where it is refused."""
    try:
        return (place_bent if bend else place_card)(mesh, frame, size_mm, spin_deg)
    except Refused:
        return None


def largest(
    size_mm: tuple[float, float], fits: Callable[[tuple[float, float]], bool], least_mm: float
) -> tuple[float, float] | None:
    """The largest piece of this shape that fits, in whole millimeters, its shorter side at least `least_mm`; None
    where not even that does.
    """
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
