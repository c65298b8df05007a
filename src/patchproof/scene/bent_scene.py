"""A mesh with a piece of paper that follows its surface (`patch.bend`): a flat card, or rolled round a cylinder.

In: a mesh, the frame a card would have, size and spin. Out: a `Placement` whose middle lies where the frame's normal
meets the surface. Paper does not stretch: where a card does not lie close, it rolls round the cylinder that fits the
surface under it best (least squares, five parameters), raised until it is clear of the surface everywhere; that height
counts as gap. Left out on purpose: paper that is stretched over surfaces curved both ways, whose photographs nobody
could unroll; cones, folds, cuts and darts.
"""

from dataclasses import replace

import numpy as np

from patchproof.base import geometry
from patchproof.base.errors import Refused
from patchproof.mesh import surface_chart
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import SurfaceChart, piece_grid
from patchproof.scene import placement
from patchproof.scene.interface import SCALE_VIEWS, Scene
from patchproof.scene.mesh_scene import MeshScene, camera_poses
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import GRID, LIFT_MM, Placement, SurfaceFrame, patch_frame, placement_method, spun_axes
from patchproof.sheets.piece import Piece

CLOSE_SHARE = 0.01  # a card is accepted up to this mean gap, as a share of the shorter edge: 0.6 mm on 60 mm
GAP_LIMIT = 0.03  # rolled paper is accepted up to this: more casts shadows that are not rendered
OVERHANG_LIMIT = 0.1  # of the area: paper with nothing to stick to does not keep the fitted shape

_REMEDY = "make the patch smaller, move it, or leave out bend"
_FIT_GRID = 33  # heights are fitted on this many points along each edge
PIECE_GRID = 33  # vertices of a bent piece along each edge; odd, so that one is the middle


def place_bent(mesh: Mesh, frame: SurfaceFrame, size_mm: tuple[float, float], spin_deg: float) -> Placement:
    """Place a piece along the surface where the frame's normal meets it, its up along the frame's; spin turns it
    clockwise as one faces it. Refused with a reason if paper cannot follow the surface.
    """
    triangles, axes = (
        mesh.triangles_near(placement.beside_mm(mesh, frame), 0.0),
        np.stack([frame.right, frame.up, frame.normal]),
    )
    frame = replace(frame, origin_mm=surface_chart.surface_point(triangles, frame.origin_mm, axes))
    # paper ends half a diagonal from its middle; a surface farther than that from its chart is not under it
    near = mesh.triangles_near(np.abs(mesh.vertices - frame.origin_mm).max(1), float(np.hypot(*size_mm)))
    tangent, curvatures = _fit_tangent(near, frame, size_mm)
    card = placement.lay_card(near, tangent, size_mm, spin_deg, _reach(size_mm))
    if card.gap_mean_mm <= CLOSE_SHARE * min(size_mm):
        _refuse_overhang(card)
        extent = np.ptp(mesh.vertices @ np.stack([tangent.right, tangent.up], 1), axis=0)
        placement.refuse_larger_than_side(size_mm, spin_deg, extent)
        return replace(card, reason=f"the surface is flat: a card stands {card.gap_mean_mm:.2f} mm off it on average")
    chart = _fit_cylinder(near, frame, tangent, curvatures, size_mm, spin_deg)
    rolled = _roll(chart, near, size_mm)
    _refuse_overhang(rolled)
    reason = (
        f"a cylinder of radius {1 / max(abs(chart.curvature), 1e-6):.0f} mm lies {rolled.gap_mean_mm:.2f} mm off the "
        f"surface on average, where a flat card would stand {card.gap_mean_mm:.1f} mm off"
    )
    return replace(rolled, reason=reason)


def _reach(size_mm) -> float:
    return float(np.hypot(*size_mm)) / 2


def _turn_frame(frame: SurfaceFrame, normal: np.ndarray) -> SurfaceFrame:
    """Return the frame turned to a normal, with its up changed as little as possible."""
    up = frame.up - (frame.up @ normal) * normal
    if np.linalg.norm(up) < 0.2:  # up is almost the normal, so that only right gives a direction
        up = np.cross(normal, frame.right)
    up /= np.linalg.norm(up)
    return replace(frame, right=np.cross(up, normal), up=up, normal=normal)


def _chart(frame: SurfaceFrame, across: np.ndarray, curvature: float, spin_deg: float) -> SurfaceChart:
    """Return a cylinder that touches the frame's plane at its origin, curved along the unit vector `across`."""
    axes = np.stack([across, np.cross(frame.normal, across), frame.normal])
    return SurfaceChart(frame.origin_mm, axes, curvature, axes[:2] @ spun_axes(frame, spin_deg)[0])


def _surface_heights(chart: SurfaceChart, near: np.ndarray, size_mm, n: int) -> np.ndarray:
    """Return heights of the surface over the piece's grid, NaN where there is none; refused if that is most of it."""
    h = surface_chart.surface_heights(chart, near, size_mm, n, (-_reach(size_mm), _reach(size_mm)))
    if np.isfinite(h).mean() < 0.5:
        got = f"a surface under {np.isfinite(h).mean():.0%} of it"
        raise Refused("a patch with the object under at least half of it", got, _REMEDY)
    return h


def _sample_surface(chart: SurfaceChart, near: np.ndarray, size_mm) -> tuple[np.ndarray, np.ndarray]:
    """Return (s, t) and heights of the surface where it lies under the piece."""
    h = _surface_heights(chart, near, size_mm, _FIT_GRID)
    hit = np.isfinite(h)
    return (piece_grid(size_mm, _FIT_GRID) @ chart.turn)[hit], h[hit]


def _fit_tangent(near: np.ndarray, frame: SurfaceFrame, size_mm) -> tuple[SurfaceFrame, np.ndarray]:
    """Return the frame turned to the surface at its origin, and the surface's 2×2 curvature there along right and up
    (positive if it bulges outwards), from a quadratic fit to the inner half under the piece.
    """
    curvatures = np.zeros((2, 2))
    for _ in range(2):
        st, h = _sample_surface(_chart(frame, frame.right, 0.0, 0.0), near, np.array(size_mm) / 2)
        s, t = st.T
        _, ds, dt, dss, dst, dtt = np.linalg.lstsq(np.stack([s**0, s, t, s**2, s * t, t**2], 1), h, rcond=None)[0]
        normal = frame.normal - ds * frame.right - dt * frame.up
        frame = _turn_frame(frame, normal / np.linalg.norm(normal))
        curvatures = -np.array([[2 * dss, dst], [dst, 2 * dtt]])
    return frame, curvatures


def _fit_cylinder(
    near: np.ndarray, frame: SurfaceFrame, tangent: SurfaceFrame, curvatures: np.ndarray, size_mm, spin_deg: float
) -> SurfaceChart:
    """Fit a cylinder to the surface under the piece; its normal goes through the frame's origin."""
    values, directions = np.linalg.eigh(curvatures)
    strongest = int(np.abs(values).argmax())
    across = directions[0, strongest] * tangent.right + directions[1, strongest] * tangent.up
    chart = _chart(tangent, across, float(values[strongest]), spin_deg)
    for share in (0.5, 1.0, 1.0):  # which surface lies under the piece depends on the cylinder
        st, h = _sample_surface(chart, near, np.array(size_mm) * share)
        chart = _refine_cylinder(chart, chart.world(st[:, 0], st[:, 1], h), frame, size_mm, spin_deg)
        around, wrapped = 2 * np.pi / max(abs(chart.curvature), 1e-9), float(np.abs(chart.turn[:, 0]) @ size_mm)
        if wrapped > around:
            got = f"{wrapped:.0f} mm of piece around a best cylinder of {around:.0f} mm"
            raise Refused("a surface on which the piece does not overlap itself", got, _REMEDY)
    return chart


def _refine_cylinder(
    chart: SurfaceChart, points_mm: np.ndarray, frame: SurfaceFrame, size_mm, spin_deg: float
) -> SurfaceChart:
    """Return the chart turned (3 angles), moved along its normal and curved again so that points are near height 0."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    unit = _reach(size_mm)  # scales millimeters and 1/mm to about 1

    def chart_at(x: np.ndarray) -> SurfaceChart:
        axes = Rotation.from_rotvec(x[:3] @ chart.axes).apply(chart.axes)
        right = spun_axes(_turn_frame(frame, axes[2]), spin_deg)[0]
        return SurfaceChart(frame.origin_mm + x[3] * unit * axes[2], axes, x[4] / unit, axes[:2] @ right)

    start = np.array([0, 0, 0, 0, chart.curvature * unit])
    # dents and bumps weigh less than the surface that the paper will lie on
    close_mm = CLOSE_SHARE * min(size_mm)
    fit = least_squares(lambda x: chart_at(x).local(points_mm)[:, 2], start, loss="soft_l1", f_scale=close_mm)
    return chart_at(fit.x)


def _roll(chart: SurfaceChart, near: np.ndarray, size_mm) -> Placement:
    """Return the piece on a cylinder, raised until it is LIFT_MM clear of the triangles under it."""
    heights, half = _surface_heights(chart, near, size_mm, GRID), np.array(size_mm) / 2
    ridges = chart.local(surface_chart.edge_points(near, 2 * _reach(size_mm) / GRID))  # which grids miss
    inside = (np.abs(np.c_[ridges[:, :2] @ chart.turn.T, ridges[:, 2]]) <= [*half, _reach(size_mm)]).all(1)
    top = max(float(np.nanmax(heights)), ridges[inside, 2].max(initial=-np.inf))
    gaps = top - heights
    gap_mean_mm = float(np.nanmean(gaps))
    if gap_mean_mm > GAP_LIMIT * min(size_mm):
        expected = f"a surface that paper stands off by at most {GAP_LIMIT:.0%} of its shorter edge on average"
        got = f"one curved both ways, or an edge, bump, hole or handle that keeps it {gap_mean_mm:.1f} mm off"
        raise Refused(expected, f"{got} ({gap_mean_mm / min(size_mm):.0%})", _REMEDY)
    cell_mm = np.abs(chart.turn[:, 0]) @ half * 2 / (PIECE_GRID - 1)
    top += LIFT_MM + max(chart.curvature, 0) * cell_mm**2 / 8  # flat cells cut below a round surface
    origin_mm = chart.origin_mm + top * chart.axes[2]
    chart = replace(chart, origin_mm=origin_mm, curvature=chart.curvature / (1 + chart.curvature * top))
    (s, t), (right, up) = (piece_grid(size_mm, PIECE_GRID) @ chart.turn).T, chart.turn @ chart.axes[:2]
    return Placement(
        family="cylinder",
        size_mm=tuple(size_mm),
        vertices_mm=chart.world(s, t, 0 * s),
        faces=surface_chart.grid_faces(PIECE_GRID, PIECE_GRID),
        piece_mm=piece_grid(size_mm, PIECE_GRID) * [1, -1] + half,
        normals=chart.cartesian(s, t)[1] @ chart.axes,
        world_from_piece=placement.piece_pose(right, up, chart.axes[2], origin_mm, size_mm),
        gap_mm=float(np.nanmax(gaps)),
        gap_mean_mm=gap_mean_mm,
        gaps_mm=gaps.reshape(GRID, GRID),
        overhang_share=float(np.isnan(heights).mean()),
        reason="",
    )


def _refuse_overhang(piece: Placement) -> None:
    if piece.overhang_share > OVERHANG_LIMIT:
        expected = f"a surface under at least {1 - OVERHANG_LIMIT:.0%} of a bent piece"
        raise Refused(expected, f"a surface under {1 - piece.overhang_share:.0%} of it", _REMEDY)


def placement_with_other_bend(scene: Scene) -> tuple[Placement | None, str | None]:
    """Return the piece's placement with `patch.bend` the other way round, and a sentence that compares it. No placement
    if it is refused or would be the same card; None for both if there is no surface to lie on.
    """
    if not isinstance(scene, PatchScene):
        return None, None
    patch, placement = scene.settings.patch, scene.placement
    lay, flag = placement_method(not patch.bend), str(not patch.bend).lower()
    try:
        other = lay(scene.mesh, patch_frame(scene.mesh, patch), scene.piece.size_mm, patch.spin_deg)
    except Refused as refused:
        return None, f"bend = {flag} is refused. {refused}"
    if other.family == placement.family:
        return None, f"bend = {flag} would be a card, too: leave bend out"
    gaps = f"{other.gap_mean_mm:.2f} mm off the surface on average, here {placement.gap_mean_mm:.2f} mm"
    return other, f"bend = {flag} would be a {other.family}, {gaps}"


def smallest_marker_scales(scene: MeshScene, placement: Placement, piece: Piece) -> np.ndarray:
    """Return the px per mm of each view at the worst marker, along the foreshortened direction; 0 from behind."""
    middles_mm = np.array([np.mean(marker.corners_mm, 0) for marker in piece.markers])
    vertices = np.linalg.norm(placement.piece_mm - middles_mm[:, None], axis=2).argmin(1)
    poses = camera_poses(scene, placement.center_mm, scene.draw("select", SCALE_VIEWS, 0).pose)
    rays = geometry.camera_centers(poses)[:, None] - placement.world(middles_mm)
    distances = np.linalg.norm(rays, axis=2)
    cosines = (rays * placement.normals[vertices]).sum(2) / distances
    return (scene.matrix_px(scene.photo_px)[0, 0] * cosines.clip(0) / distances).min(1)
