"""What a file tells of an object before anybody says it: which axis is up, how long it is, what it is called, and
where a piece goes on it.

In: a mesh file, and names of files. Out: `UpGuess`, a length in millimeters, a label, and `PieceGuess`: the largest piece that
lies well in the middle of one of its sides. Each guess carries the words for the comment beside it in the scene file.
Where there is no telling, a length is refused, since everything in a scene is in millimeters; so is a label.
Left out on purpose: other places than middles, which the search for a place knows better.

glTF has a standard: y up, meters. Other formats have habits: OBJ is mostly written y up, printers' STL and scanners'
PLY z up, all without units. Whether an object lies oddly is judged by what it would stand on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Literal

import numpy as np

from patchproof.app.begin.sides import SIDE_NAMES
from patchproof.base.errors import Refused
from patchproof.base.validation import Side
from patchproof.classifier.labels import find_labels, find_words
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.mesh import Mesh
from patchproof.scene.bend import placement_method
from patchproof.scene.fitting import largest_fitting_size, place_if_close
from patchproof.scene.placement import SurfaceFrame, side_frame
from patchproof.sheets.piece import smallest_piece_mm

_GLTF = (".glb", ".gltf")
UpAxis = Literal["y", "z"]
_HABIT: dict[str, UpAxis] = {".obj": "y", ".stl": "z", ".ply": "z"}
_MM_PER_M = 1000.0
_SENSIBLE_MM = (5.0, 30_000.0)  # what people hang paper on
_FOOT = 0.005  # of the object's height: what is no higher touches the ground
_HARDLY = 0.25  # of its footprint: a cylinder that lies touches 14 % by these rules, one that stands 79 %
_FIRMLY = 2.0  # times as much: where the other axis is clearly the better one
_FEW_LABELS = 20  # of a network: all of them are said
_SIDE_SHARE = 0.7  # of a side's extent that a piece covers at most
_LARGEST_MM = (165.0, 175.0)  # of a piece on A4, with the chart and the rulers around it
_LONGER = 1.6  # a piece's longer side over its shorter one at most
_FRONT = 1.25  # times as large has to be what is preferred to the front, or to a flat card
_TOP = 0.5  # of a top's size: who looks at it looks from above, as few photographs do
_ENOUGH = 0.8  # of the largest piece that any side is asked for: a flat card as large is not bent for more
_TRIED: tuple[Side, ...] = ("+z", "+x", "-x", "-z", "+y")


@dataclass(frozen=True)
class UpGuess:
    """The axis of the file that points up, why, and whether that is odd."""

    axis: UpAxis
    reason: str
    odd: str | None = None


def guess_up(path: Path) -> UpGuess:
    """The axis by the format's standard or habit; one that the object hardly stands on is odd, and of a mere habit the
    other one is taken then.
    """
    kind, name = path.suffix.lower(), path.suffix[1:].upper()
    axis: UpAxis = "y" if kind in _GLTF else _HABIT.get(kind, "z")
    odd = lying_hint(load_mesh(path, 100.0, axis).vertices, axis)
    if odd is not None and kind not in _GLTF:
        return UpGuess(other_axis(axis), f"as it stands: {name} files say nothing")
    return UpGuess(axis, "glTF's standard" if kind in _GLTF else f"the habit of {name} files", odd)


def lying_hint(vertices: np.ndarray, up: UpAxis) -> str | None:
    """Words for an object (y up here, its file's `up` taken for that) that would stand clearly better with the file's
    other axis up; None for any other.
    """
    x, y, z = vertices.T
    turned = np.stack([x, z, -y] if up == "y" else [x, -z, y], 1)
    stands, would = footing(vertices), footing(turned)
    if stands >= _HARDLY or would < max(_HARDLY, _FIRMLY * stands):
        return None
    return f'it stands on {stands:.0%} of its footprint so, with "{other_axis(up)}" on {would:.0%}'


def other_axis(up: UpAxis) -> UpAxis:
    """The other one of those that point up in files."""
    return "z" if up == "y" else "y"


def footing(vertices: np.ndarray) -> float:
    """The share of an object's footprint (y up) that lies between the points that touch the ground."""
    from scipy.spatial import ConvexHull, QhullError

    low, size = vertices.min(0), np.ptp(vertices, axis=0)
    touching = vertices[vertices[:, 1] <= low[1] + _FOOT * size[1]][:, [0, 2]]
    try:
        return float(ConvexHull(touching).volume / (size[0] * size[2]))  # of a plane's points, the area
    except (QhullError, ValueError):
        return 0.0


def guess_length_mm(path: Path) -> float:
    """The longest extent by the file's own units; refused where it has none, or none that make sense."""
    do = "add --length-mm with the object's longest extent"
    if path.suffix.lower() not in _GLTF:
        got = f"{path.name}, which has no units"
        raise Refused("a file that says how large the object is", got, f"{do}: {file_length(path):.3g} if it is in mm")
    length_mm = file_length(path) * _MM_PER_M
    low, high = _SENSIBLE_MM
    if not low <= length_mm <= high:
        raise Refused(f"an object of {low:g} mm to {high / 1000:g} m", f"{length_mm:.3g} mm by the file's units", do)
    return float(f"{length_mm:.3g}")


def file_length(path: Path) -> float:
    """The longest extent in the file's own unit."""
    from patchproof.mesh.mesh_file import read_parts

    parts, _ = read_parts(path, np.eye(3))
    corners = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    corners = corners[np.isfinite(corners).all(1)]
    return float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0


def guess_label(labels: Sequence[str], said: str | None, path: str) -> str | int:
    """The label as a scene file writes it: what was said, found by its words, or what the file is called."""
    if said is not None:
        return _written(labels, find_words(labels, said))
    words = [word for word in re.split(r"[^a-z]+", re.split(r"[/\\:]", path)[-1].rsplit(".", 1)[0].casefold()) if word]
    for text in (" ".join(words), *words):
        try:
            return _written(labels, find_words(labels, text, whole=True))
        except Refused:
            continue
    few = ": " + ", ".join(f'"{label}"' for label in labels) if len(labels) <= _FEW_LABELS else ""
    do = f"add --label with what it is to be recognized as{few}"
    raise Refused("a file that is called what it shows", f'"{" ".join(words)}", which no label of the network is', do)


def _written(labels: Sequence[str], index: int) -> str | int:
    """The shortest way to name an entry that leads back to it."""
    for name in (labels[index].split(",")[0].strip(), labels[index]):
        try:
            if find_labels(labels, name) == (index,):
                return name
        except Refused:
            continue
    return index


@dataclass(frozen=True)
class PieceGuess:
    """Where the piece goes: a side's middle, or wherever the search finds; how large it is, and whether it bends."""

    side: Side | None
    size_mm: tuple[float, float]
    bend: bool

    @property
    def worth(self) -> float:
        """Its area, that of a flat card on the front counting more, and on the top less."""
        sides: dict[Side | None, float] = {"+z": _FRONT, "+y": _TOP}
        return prod(self.size_mm) * (1 if self.bend else _FRONT) * sides.get(self.side, 1)

    @property
    def words(self) -> str:
        """Where that is, for a sentence."""
        where = "wherever the search finds" if self.side is None else f"on its {SIDE_NAMES[self.side]} ({self.side})"
        return f"{'bent, ' if self.bend else ''}{where}"


def guess_piece(mesh: Mesh, length_mm: float) -> PieceGuess:
    """The largest piece that lies well in the middle of a side; where none does, the least, to be searched for."""
    sides: dict[Side, tuple[float, float]] = {side: _wanted(side_frame(mesh, side)) for side in _TRIED}
    flat = [hang for side, size in sides.items() if (hang := _on_side(mesh, side, size, False))]
    if any(prod(hang.size_mm) >= _ENOUGH * max(map(prod, sides.values())) for hang in flat):
        return max(flat, key=lambda hang: hang.worth)  # bending takes seconds to try
    hangs = flat + [hang for side, size in sides.items() if (hang := _on_side(mesh, side, size, True))]
    if hangs:
        return max(hangs, key=lambda hang: hang.worth)
    least = smallest_piece_mm()
    if least > length_mm:
        do = "check --length-mm: markers of 8 mm need that much"
        raise Refused(f"an object with room for a piece of {least:g} mm", f"one of {length_mm:g} mm", do)
    return PieceGuess(None, (least, least), False)


def _wanted(frame: SurfaceFrame) -> tuple[float, float]:
    """The largest piece that a side is asked for."""
    width, height = (_SIDE_SHARE * extent for extent in frame.extent_mm)
    return min(width, _LONGER * height, _LARGEST_MM[0]), min(height, _LONGER * width, _LARGEST_MM[1])


def _on_side(mesh: Mesh, side: Side, size_mm: tuple[float, float], bend: bool) -> PieceGuess | None:
    """The largest piece of that shape that lies well in the middle of a side."""
    frame, lay = side_frame(mesh, side), placement_method(bend)
    found = largest_fitting_size(
        size_mm, lambda trial: place_if_close(mesh, frame, trial, 0.0, lay), smallest_piece_mm()
    )
    return None if found is None else PieceGuess(side, found, bend)
