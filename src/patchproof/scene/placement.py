"""Place paper on an object: a flat rigid card that touches the highest surface points under it.

In: a mesh (world mm), a named side or a point, a spin and the piece's size. Out: a `Placement`: the piece in the world,
and how well paper and surface agree: the gap below the card and the overhang beyond the object, in mm and shares. A
card wider or higher than the object's side, or with nothing under it, is refused. Bent pieces: see `bent_scene`.

A piece lies well if gap and overhang are below those that give a warning. The largest that does is found by bisection,
on the assumption that a smaller piece fits where a larger one does, which only holes under its middle contradict.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.geometry import rotated_extent
from patchproof.base.settings import PatchSettings, SceneSettings
from patchproof.base.validation import Side
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import SurfaceChart, grid_faces, surface_heights

GRID = 65  # heights are sampled on this many points along each edge of the card
LIFT_MM = 0.15  # the paper's own thickness, which also keeps it clear of the surface in the z-buffer
# Assumed: a card that stands off the object by more than this share of its shorter edge casts a visible shadow.
WARN_GAP_SHARE = 0.15
WARN_OVERHANG_SHARE = 0.02
_HALVINGS = 5  # to 3 % of the wanted piece

_SIDES = {  # side: (up, normal); right is up × normal
    "+x": ((0, 1, 0), (1, 0, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0)),
    "+y": ((0, 0, -1), (0, 1, 0)),
    "-y": ((0, 0, 1), (0, -1, 0)),
    "+z": ((0, 1, 0), (0, 0, 1)),
    "-z": ((0, 1, 0), (0, 0, -1)),
}


@dataclass(frozen=True)
class Placement:
    """A piece at its place. Piece millimeters count from its top-left corner, x right, y down."""

    family: str  # "card", "cylinder" or "curled"
    size_mm: tuple[float, float]
    vertices_mm: np.ndarray  # float64 V×3 in the world: a grid by rows, of a card its corners
    faces: np.ndarray  # int64 F×3, counter-clockwise as one faces the printed side
    piece_mm: np.ndarray  # V×2: where each vertex lies on the flat piece
    normals: np.ndarray  # V×3 unit, out of the printed face
    world_from_piece: np.ndarray  # 4×4, z into the object: the card's frame, or the bent piece's tangent at its middle
    gap_mm: float  # largest distance from the piece to the surface under it
    gap_mean_mm: float
    gaps_mm: np.ndarray  # GRID×GRID by rows from the top: from the piece to the surface, NaN where there is none
    overhang_share: float  # of the piece's area with no object under it
    reason: str

    def world(self, points_mm: np.ndarray) -> np.ndarray:
        """Return the world millimeters N×3 of piece points N×2; bilinear between a bent piece's vertices."""
        frame = self.world_from_piece
        if self.is_flat:
            return points_mm @ frame[:3, :2].T + frame[:3, 3]
        from scipy.interpolate import interpn

        xs, ys = (np.unique(self.piece_mm[:, i]) for i in range(2))
        grid = self.vertices_mm.reshape(len(ys), len(xs), 3)
        rows_and_columns = points_mm[:, ::-1]  # None extrapolates, which scipy's stubs do not know
        return interpn((ys, xs), grid, rows_and_columns, bounds_error=False, fill_value=None)  # pyright: ignore[reportArgumentType]

    @property
    def is_flat(self) -> bool:
        """True if the piece is a plane, so that its picture is a homography of the sheet."""
        return self.family == "card"

    @property
    def normal(self) -> np.ndarray:
        """Unit vector out of the paper's face, at the piece's middle."""
        return -self.world_from_piece[:3, 2]

    @property
    def center_mm(self) -> np.ndarray:
        """The middle of the piece in the world."""
        return self.world(np.array([self.size_mm]) / 2)[0]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about a large gap or overhang."""
        notes = []
        if self.gap_mm > gap_limit_mm(self.size_mm):
            share = f"{self.gap_mm / min(self.size_mm):.0%} of its shorter edge"
            notes.append(f"the piece stands up to {self.gap_mm:.0f} mm ({share}) off the surface")
        if self.overhang_share > WARN_OVERHANG_SHARE:
            notes.append(f"{self.overhang_share:.0%} of the piece overhangs the object")
        return tuple(notes)


@dataclass(frozen=True)
class SurfaceFrame:
    """Axes of the place that a patch faces: unit vectors in the world, and the point that the patch is centered at."""

    right: np.ndarray
    up: np.ndarray
    normal: np.ndarray
    origin_mm: np.ndarray
    extent_mm: tuple[float, float]  # the object's size along right and up


# places a piece of a size and spin (degrees) on a mesh at a frame's origin, or refuses it
PlacementMethod = Callable[[Mesh, SurfaceFrame, tuple[float, float], float], Placement]


def placement_method(bend: bool) -> PlacementMethod:
    """Return the method that places a piece on a surface: bent along it, or as a flat card."""
    if not bend:
        return place_card
    from patchproof.scene.bent_scene import place_bent

    return place_bent


def patch_frame(mesh: Mesh, patch: PatchSettings) -> SurfaceFrame:
    """Return the frame of the patch's side, or of the surface point nearest to `at_mm`."""
    if patch.at_mm is None:
        frame = side_frame(mesh, patch.side)
    else:
        frame = surface_frame(mesh, *_nearest_surface(mesh, np.array(patch.at_mm, float)))
    return replace(frame, origin_mm=frame.origin_mm + patch.offset_mm[0] * frame.right + patch.offset_mm[1] * frame.up)


def view_frame(mesh: Mesh, settings: SceneSettings) -> SurfaceFrame:
    """Return the frame from which the azimuths of cameras and lights count: the patch's, or that of `view.front`. A
    piece without a place is seen as if it were on its side.
    """
    front = settings.view.front
    return patch_frame(mesh, settings.patch) if front == "patch" else side_frame(mesh, front)


def side_frame(mesh: Mesh, side: Side) -> SurfaceFrame:
    """Return the frame in the middle of a side of the object's bounding box."""
    low, high = mesh.ends_mm
    up, normal = (np.array(v, float) for v in _SIDES[side])
    center = (low + high) / 2 + normal * (np.abs(normal) @ (high - low)) / 2
    return _frame(mesh, np.cross(up, normal), up, normal, center)


def surface_frame(mesh: Mesh, point_mm: np.ndarray, normal: np.ndarray) -> SurfaceFrame:
    """Return the frame at a point of the surface with that unit normal, as level as possible."""
    level = np.array([0.0, 1, 0]) if abs(normal[1]) < 0.99 else np.array([0.0, 0, -1])
    right = np.cross(level, normal)
    right /= np.linalg.norm(right)
    return _frame(mesh, right, np.cross(normal, right), normal, point_mm)


def _frame(mesh: Mesh, right: np.ndarray, up: np.ndarray, normal: np.ndarray, origin_mm: np.ndarray) -> SurfaceFrame:
    wide, high = np.ptp(mesh.vertices @ np.stack([right, up], 1), axis=0).tolist()
    return SurfaceFrame(right, up, normal, origin_mm, (wide, high))


def place_card(mesh: Mesh, frame: SurfaceFrame, size_mm: tuple[float, float], spin_deg: float) -> Placement:
    """Place a card of `size_mm` on the surface, its middle at the frame's origin; spin turns it clockwise as one faces
    it. Refused if it is larger than the object's side.
    """
    refuse_larger_than_side(size_mm, spin_deg, frame.extent_mm)
    triangles = mesh.triangles_near(beside_mm(mesh, frame), float(np.hypot(*size_mm)) / 2)
    return lay_card(triangles, frame, size_mm, spin_deg)


def beside_mm(mesh: Mesh, frame: SurfaceFrame) -> np.ndarray:
    """Return how far each vertex V lies from the line through the frame's origin along its normal."""
    return np.hypot(*((mesh.vertices - frame.origin_mm) @ np.stack([frame.right, frame.up], 1)).T)


def lay_card(
    triangles: np.ndarray, frame: SurfaceFrame, size_mm, spin_deg: float, reach_mm: float = np.inf
) -> Placement:
    """Place a card of any size on triangles F×3×3; surface beyond `reach_mm` from the frame's plane does not count."""
    width, height = size_mm
    right, up = spun_axes(frame, spin_deg)
    chart = SurfaceChart(frame.origin_mm, np.stack([right, up, frame.normal]), 0.0, np.array([1.0, 0.0]))
    surface = surface_heights(chart, triangles, size_mm, GRID, (-reach_mm, reach_mm))
    hit = np.isfinite(surface)
    if not hit.any():
        raise Refused("a patch that lies on the object", "no surface under it", "change offset_mm or at_mm")
    # peaks are at corners, which the grid may miss
    peaks = chart.local(triangles.reshape(-1, 3))
    inside = (np.abs(peaks) <= [width / 2, height / 2, reach_mm]).all(1)
    top = max(surface[hit].max(), peaks[inside, 2].max(initial=-np.inf))
    gaps = top - surface[hit]
    pose = piece_pose(right, up, frame.normal, frame.origin_mm + frame.normal * (top + LIFT_MM), size_mm)
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], float)
    gap_mm = float(gaps.max())
    return Placement(
        family="card",
        size_mm=(width, height),
        vertices_mm=corners @ pose[:3, :2].T + pose[:3, 3],
        faces=grid_faces(2, 2),
        piece_mm=corners,
        normals=np.tile(frame.normal, (4, 1)),
        world_from_piece=pose,
        gap_mm=gap_mm,
        gap_mean_mm=float(gaps.mean()),
        gaps_mm=(top - surface).reshape(GRID, GRID),
        overhang_share=float(1 - hit.mean()),
        reason=f"a flat card stands at most {gap_mm:.1f} mm off the surface",
    )


def piece_pose(right: np.ndarray, up: np.ndarray, normal: np.ndarray, middle_mm: np.ndarray, size_mm) -> np.ndarray:
    """Return the 4×4 world from piece of a piece with its middle at `middle_mm`."""
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, -up, -normal], 1)
    pose[:3, 3] = middle_mm - right * size_mm[0] / 2 + up * size_mm[1] / 2
    return pose


def spun_axes(frame: SurfaceFrame, spin_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the piece's right and up in the world."""
    c, s = np.cos(np.radians(spin_deg)), np.sin(np.radians(spin_deg))
    return c * frame.right - s * frame.up, s * frame.right + c * frame.up


def refuse_larger_than_side(size_mm: tuple[float, float], spin_deg: float, extent_mm) -> None:
    """Refuse a card that reaches beyond the object's outline; 0.5 % of tolerance for rounded numbers."""
    across, along = rotated_extent(size_mm, spin_deg)
    if across > 1.005 * extent_mm[0] or along > 1.005 * extent_mm[1]:
        expected = f"a piece no larger than the object's side ({extent_mm[0]:.0f} × {extent_mm[1]:.0f} mm)"
        raise Refused(expected, f"{across:.0f} × {along:.0f} mm", "make the patch smaller or choose a larger side")


def gap_limit_mm(size_mm) -> float:
    """Return how far a piece may stand off the surface without a warning."""
    return WARN_GAP_SHARE * min(size_mm)


def _nearest_surface(mesh: Mesh, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the surface point nearest to `point` and its face's unit normal."""
    from trimesh.triangles import closest_point, normals

    distances = np.linalg.norm(mesh.vertices - point, axis=1)
    triangles = mesh.triangles_near(distances, float(distances.min()))  # none is nearer than the nearest corner's
    points = closest_point(triangles, np.broadcast_to(point, (len(triangles), 3)))
    nearest = int(np.argmin(((points - point) ** 2).sum(1)))
    return points[nearest], normals(triangles[nearest : nearest + 1])[0][0]


def place_if_close(
    mesh: Mesh, frame: SurfaceFrame, size_mm: tuple[float, float], spin_deg: float, lay: PlacementMethod
) -> Placement | None:
    """Place the piece with its middle at the frame's origin. None if that is refused, or if the piece stands off or
    overhangs by more than the limits of the warnings.
    """
    try:
        piece = lay(mesh, frame, size_mm, spin_deg)
    except Refused:
        return None
    return None if piece.warnings else piece


def placement_advice(mesh: Mesh, patch: PatchSettings, lay: PlacementMethod, least_mm: float) -> str:
    """Suggest a size at which a refused piece would lie well, if there is one, and how to search for a place."""
    frame, (width, height) = patch_frame(mesh, patch), patch.size_mm
    largest = min(width, frame.extent_mm[0]), min(height, frame.extent_mm[1])
    fits = partial(place_if_close, mesh, frame, spin_deg=patch.spin_deg, lay=lay)
    smaller = largest_fitting_size(largest, fits, least_mm)
    advice = "" if smaller is None else f"; {smaller[0]:g} × {smaller[1]:g} mm lies well there"
    return f'{advice}; place = "auto" searches for a place'


def largest_fitting_size(
    size_mm: tuple[float, float], fits: Callable[[tuple[float, float]], object], least_mm: float
) -> tuple[float, float] | None:
    """Return the largest piece of this shape that fits, in whole millimeters; None if `least_mm` does not."""
    low, high = least_mm / max(min(size_mm), 1e-9), 1.0  # a flat mesh has sides of no extent
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
