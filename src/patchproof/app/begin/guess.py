"""Guess from a mesh file what a scene needs: the axis that is up, length, label, and where a piece goes.

In: a mesh file and its name. Out: its up axis, a length in millimeters, a label, and `PieceGuess`: the largest piece
that fits in the middle of one of the sides. Each guess has the words for its comment in the scene file. If a length or
a label cannot be guessed, that is refused. Left out on purpose: places other than middles, which the search for a place
covers.

glTF has a standard: y up, meters. Other formats have conventions: OBJ is mostly written y up, printers' STL and
scanners' PLY z up, all without units. An up axis is doubted if the object would stand on much more of its footprint
with the other one.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path
from typing import Literal

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.validation import Side, folded
from patchproof.classifier.labels import find_labels, nearest_hint
from patchproof.mesh.load_mesh import load_mesh, read_parts
from patchproof.mesh.mesh import Mesh
from patchproof.scene.placement import SurfaceFrame, largest_fitting_size, place_if_close, placement_method, side_frame
from patchproof.sheets.piece import smallest_piece_mm

_GLTF = (".glb", ".gltf")
UpAxis = Literal["y", "z"]
_MM_PER_M = 1000.0
_LENGTH_RANGE_MM = (5.0, 6_000.0)  # of objects that people put paper on, up to a van; a mug of 12 m has other units
_GROUND_SHARE = 0.005  # of the object's height: lower points touch the ground
_LEAST_FOOTING = 0.25  # of the footprint: a lying cylinder touches 14 % of it by these rules, a standing one 79 %
_FOOTING_RATIO = 2.0  # from which on the other axis is clearly better
_MOST_LISTED_LABELS = 20  # of a network, in a refusal
_SIDE_SHARE = 0.7  # of a side's extent that a piece covers at most
_LARGEST_MM = (165.0, 175.0)  # of a piece on A4, with the chart and the rulers around it
_LARGEST_RATIO = 1.6  # of a piece's sides
_PREFERENCE = 1.25  # weight of the area of a piece on the front, and of a flat one
_TOP_WEIGHT = 0.5  # of the area of a piece on top, which few photographs show well
_ENOUGH_AREA = 0.8  # of the largest wanted piece: for more than a flat card of that size, none is bent
SIDE_NAMES: dict[Side, str] = {"+z": "front", "-z": "back", "-x": "left", "+x": "right", "+y": "top", "-y": "bottom"}
_SIDES: tuple[Side, ...] = ("+z", "+x", "-x", "-z", "+y")


def guess_up(path: Path) -> tuple[UpAxis, str, str | None]:
    """Guess the up axis by the format's standard or convention: the axis, the reason, and the words for a doubt about
    it. If the object would stand much better with the other axis up, a convention is overruled, and a standard is
    doubted.
    """
    kind, name = path.suffix.lower(), path.suffix[1:].upper()
    axis: UpAxis = "y" if kind in (*_GLTF, ".obj") else "z"
    doubt = lying_hint(load_mesh(path, 100.0, axis).vertices, axis)
    if doubt is not None and kind not in _GLTF:
        return other_axis(axis), f"as it stands best: {name} files do not name the axis that is up", None
    return axis, "glTF's standard" if kind in _GLTF else f"usual in {name} files", doubt


def lying_hint(vertices: np.ndarray, up: UpAxis) -> str | None:
    """Say that the object (`vertices` with y up, after turning the file's axis `up`) would stand clearly better with
    the file's other axis up; None if it would not.
    """
    x, y, z = vertices.T
    turned = np.stack([x, z, -y] if up == "y" else [x, -z, y], 1)
    share, turned_share = footing(vertices), footing(turned)
    if share >= _LEAST_FOOTING or turned_share < max(_LEAST_FOOTING, _FOOTING_RATIO * share):
        return None
    return f'this way up its base covers {share:.0%} of its footprint, with "{other_axis(up)}" up {turned_share:.0%}'


def other_axis(up: UpAxis) -> UpAxis:
    """The other one of the axes that point up in files."""
    return "z" if up == "y" else "y"


def footing(vertices: np.ndarray) -> float:
    """The area between the points that touch the ground, as a share of the object's footprint (y up)."""
    from scipy.spatial import ConvexHull, QhullError

    low, size = vertices.min(0), np.ptp(vertices, axis=0)
    touching = vertices[vertices[:, 1] <= low[1] + _GROUND_SHARE * size[1]][:, [0, 2]]
    try:
        return float(ConvexHull(touching).volume / (size[0] * size[2]))  # of a plane's points, the area
    except (QhullError, ValueError):
        return 0.0


def guess_length_mm(path: Path) -> float:
    """Guess the longest extent by the file's units; refused if it has none, or if the result is implausible."""
    do = "add --length-mm with the object's longest extent"
    if path.suffix.lower() not in _GLTF:
        got = f"{path.name}, which has no units"
        raise Refused("a file that says how large the object is", got, f"{do}: {file_length(path):.3g} if it is in mm")
    length_mm = float(f"{file_length(path) * _MM_PER_M:.3g}")
    low, high = _LENGTH_RANGE_MM
    if not low <= length_mm <= high:
        got = f"{length_mm:g} mm by the units of {path.name}"
        raise Refused(f"an object of {low:g} mm to {high / 1000:g} m", got, f"{do}: {length_mm:g} if that is right")
    return length_mm


def file_length(path: Path) -> float:
    """The longest extent in the file's own unit."""
    parts, *_ = read_parts(path, np.eye(3))
    corners = np.concatenate([part.vertices[part.faces].reshape(-1, 3) for part in parts])
    corners = corners[np.isfinite(corners).all(1)]
    return float(np.ptp(corners, axis=0).max()) if len(corners) else 0.0


def guess_label(labels: Sequence[str], words: str | None, path: str) -> str | int:
    """Find the label for a scene file by the user's words, or by those of the file's name; refused if none fits."""
    if words is not None:
        return _scene_label(labels, _find_words(labels, words))
    stem = re.split(r"[/\\:]", path)[-1].rsplit(".", 1)[0].casefold()
    parts = [part for part in re.split(r"[^a-z]+", stem) if part]
    for text in (" ".join(parts), *parts):
        try:
            return _scene_label(labels, _find_words(labels, text, whole=True))
        except Refused:
            continue
    known = ": " + ", ".join(f'"{label}"' for label in labels) if len(labels) <= _MOST_LISTED_LABELS else ""
    got = f'"{" ".join(parts)}", which no label of the network is'
    raise Refused("a file that is called what it shows", got, f"add --label with what it is to be recognized as{known}")


def _scene_label(labels: Sequence[str], index: int) -> str | int:
    """The shortest name that finds the label at that index, else the index itself."""
    for name in (labels[index].split(",")[0].strip(), labels[index]):
        try:
            if find_labels(labels, name) == (index,):
                return name
        except Refused:
            continue
    return index


@dataclass(frozen=True)
class PieceGuess:
    """The place, size and bend of a piece: the middle of a side, or (None) the place that the search will find."""

    side: Side | None
    size_mm: tuple[float, float]
    bend: bool

    @property
    def weighted_area(self) -> float:
        """The piece's area in mm², weighted more if it is flat or on the front, and less on the top."""
        weights: dict[Side | None, float] = {"+z": _PREFERENCE, "+y": _TOP_WEIGHT}
        return prod(self.size_mm) * (1 if self.bend else _PREFERENCE) * weights.get(self.side, 1)


def guess_piece(mesh: Mesh, length_mm: float) -> PieceGuess:
    """Find the largest piece that fits in the middle of a side; if none does, the smallest, whose place is searched."""
    sides: dict[Side, tuple[float, float]] = {side: _wanted_size_mm(side_frame(mesh, side)) for side in _SIDES}
    flat = [piece for side, size in sides.items() if (piece := _fit_on_side(mesh, side, size, False))]
    if any(prod(piece.size_mm) >= _ENOUGH_AREA * max(map(prod, sides.values())) for piece in flat):
        return max(flat, key=lambda piece: piece.weighted_area)  # bending takes seconds to try
    if pieces := flat + [piece for side, size in sides.items() if (piece := _fit_on_side(mesh, side, size, True))]:
        return max(pieces, key=lambda piece: piece.weighted_area)
    least = smallest_piece_mm()
    if least > length_mm:
        do = "check --length-mm: markers of 8 mm need that much"
        raise Refused(f"an object with room for a piece of {least:g} mm", f"an object of {length_mm:g} mm", do)
    return PieceGuess(None, (least, least), False)


def _wanted_size_mm(frame: SurfaceFrame) -> tuple[float, float]:
    """The largest piece that is tried on a side."""
    width, height = (_SIDE_SHARE * extent for extent in frame.extent_mm)
    return min(width, _LARGEST_RATIO * height, _LARGEST_MM[0]), min(height, _LARGEST_RATIO * width, _LARGEST_MM[1])


def _fit_on_side(mesh: Mesh, side: Side, size_mm: tuple[float, float], bend: bool) -> PieceGuess | None:
    """The largest piece of that shape that fits in the middle of a side."""
    frame, lay = side_frame(mesh, side), placement_method(bend)
    fitted_mm = largest_fitting_size(size_mm, lambda mm: place_if_close(mesh, frame, mm, 0.0, lay), smallest_piece_mm())
    return None if fitted_mm is None else PieceGuess(side, fitted_mm, bend)


def _find_words(labels: Sequence[str], text: str, whole: bool = False) -> int:
    """The index of the label with these words: "mug" finds "coffee mug", whose last word it is. With `whole`, the words
    must be a label's whole name or its last words. Refused where several labels or none match.
    """
    words, names = folded(text).split(), [[folded(name).split() for name in (e, *e.split(","))] for e in labels]
    ranks = (
        lambda name: name == words,
        lambda name: name[-len(words) :] == words,
        lambda name: not whole and set(words) <= set(name),
    )
    for rank in ranks:
        matches = [i for i, entry_names in enumerate(names) if words and any(map(rank, entry_names))]
        if len(matches) == 1:
            return matches[0]
        if matches:
            shown = ", ".join(f'"{labels[i].split(",")[0]}"' for i in matches[:6])
            more = ", ..." if len(matches) > 6 else ""
            raise Refused("words of one label", f'"{text}", which is in {len(matches)} labels', f"choose {shown}{more}")
    raise Refused("a label that the network knows", f'"{text}"', nearest_hint(labels, text))
