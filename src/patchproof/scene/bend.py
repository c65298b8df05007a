"""Place paper that follows the surface: a flat card, an unrolled cylinder, or an exponential map, whichever fits first.

In: a mesh, the frame a card would have, size and spin. Out: a `Placement` whose middle lies where the frame's normal
meets the surface. A cylinder is fitted to the surface under the piece (least squares, five parameters); paper rolls
around it without any stretch. If it stands off too far, the surface becomes the cylinder plus a polynomial of degree 4,
and the piece the exponential map of its middle. The polynomial stands for the paper's stiffness: it does not follow
facets or small dents. In each of these families the piece is raised until it is clear of the surface everywhere, and
that height counts as gap. Left out on purpose: folds, cuts and darts.
"""

from dataclasses import replace

import numpy as np

from patchproof.base.errors import Refused
from patchproof.mesh import surface_chart
from patchproof.mesh.exponential_map import SmoothSurface, exponential_map, grid_stretch
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import SurfaceChart, piece_grid
from patchproof.scene import placement
from patchproof.scene.placement import GRID, LIFT_MM, Placement, PlacementMethod, SurfaceFrame, piece_pose, spun_axes

# A simpler family is accepted up to this mean gap, as a share of the shorter edge: 0.6 mm on 60 mm.
CLOSE_SHARE = 0.01
GAP_LIMIT = 0.03  # the last family is accepted up to this: more casts shadows that are not rendered
# Assumed: paper breaks at about 1 to 3 % of strain, so that it follows this much without wrinkles or tears (vinyl
# follows more); it is also how far lengths on the surface may differ from the sheet's.
STRETCH_LIMIT = 0.01
OVERHANG_LIMIT = 0.1  # of the area: paper with nothing to stick to does not keep the fitted shape

_REMEDY = "make the patch smaller, move it, or leave out bend"
_FIT_GRID = 33  # heights are fitted on this many points along each edge
PIECE_GRID = 33  # vertices of a bent piece along each edge; odd, so that one is the middle
_DEGREE = 4


def placement_method(bend: bool) -> PlacementMethod:
    """Return the method that places a piece on a surface: bent along it, or as a flat card."""
    return place_bent if bend else placement.place_card


def place_bent(mesh: Mesh, frame: SurfaceFrame, size_mm: tuple[float, float], spin_deg: float) -> Placement:
    """Place a piece of `size_mm` along the surface, its middle where the frame's normal meets it and its up along the
    frame's; spin turns it clockwise as one faces it. Refused with a reason if paper cannot follow the surface.
    """
    triangles, axes = mesh.vertices[mesh.faces], np.stack([frame.right, frame.up, frame.normal])
    middle = surface_chart.surface_point(triangles, frame.origin_mm, axes)
    # paper ends half a diagonal from its middle; a surface farther than that from its chart is not under it
    near = surface_chart.triangles_near(triangles, middle, float(np.hypot(*size_mm)))
    reach = float(np.hypot(*size_mm)) / 2
    tangent, curvatures = _fit_tangent(near, _turn_frame(frame, frame.normal, middle), size_mm)
    close_mm = CLOSE_SHARE * min(size_mm)
    card = placement.lay_card(near, tangent, size_mm, spin_deg, reach)
    if card.gap_mean_mm <= close_mm:
        _refuse_overhang(card)
        extent = np.ptp(mesh.vertices @ np.stack([tangent.right, tangent.up], 1), axis=0)
        placement.refuse_larger_than_side(size_mm, spin_deg, extent)
        return replace(card, reason=f"the surface is flat: a card stands {card.gap_mean_mm:.2f} mm off it on average")
    chart = _fit_cylinder(near, tangent, curvatures, size_mm, spin_deg)
    rolled = _lay_on(SmoothSurface(chart, np.zeros((1, 1)), 1.0), near, frame, size_mm, spin_deg)
    _refuse_overhang(rolled)
    if rolled.gap_mean_mm <= close_mm:
        radius_mm = 1 / max(abs(chart.curvature), 1e-6)
        reason = (
            f"a cylinder of radius {radius_mm:.0f} mm lies {rolled.gap_mean_mm:.2f} mm off the surface on average, "
            f"where a flat card would stand {card.gap_mean_mm:.1f} mm off"
        )
        return replace(rolled, family="cylinder", reason=reason)
    mapped = _lay_on(_fit_polynomial(chart, near, size_mm), near, frame, size_mm, spin_deg)
    _refuse_gap(mapped.gap_mean_mm, size_mm)
    if mapped.stretch > STRETCH_LIMIT:
        expected = f"a surface that paper follows with a stretch of at most {STRETCH_LIMIT:.0%}"
        raise Refused(expected, f"a surface curved both ways, which needs {mapped.stretch:.1%}", _REMEDY)
    reason = (
        f"paper that follows the surface is stretched by {mapped.stretch:.2%} at most and lies {mapped.gap_mean_mm:.2f}"
        f" mm off on average, where the best cylinder would stand {rolled.gap_mean_mm:.1f} mm off"
    )
    return replace(mapped, reason=reason)


def _turn_frame(frame: SurfaceFrame, normal: np.ndarray, origin_mm: np.ndarray) -> SurfaceFrame:
    """Return the frame turned to a normal, with its up changed as little as possible."""
    up = frame.up - (frame.up @ normal) * normal
    if np.linalg.norm(up) < 0.2:  # up is almost the normal, so that only right gives a direction
        up = np.cross(normal, frame.right)
    up /= np.linalg.norm(up)
    return SurfaceFrame(np.cross(up, normal), up, normal, origin_mm, frame.extent_mm)


def _chart(frame: SurfaceFrame, across: np.ndarray, curvature: float, spin_deg: float) -> SurfaceChart:
    """Return a cylinder that touches the frame's plane at its origin, curved along the unit vector `across`."""
    axes = np.stack([across, np.cross(frame.normal, across), frame.normal])
    return SurfaceChart(frame.origin_mm, axes, curvature, axes[:2] @ spun_axes(frame, spin_deg)[0])


def _surface_heights(chart: SurfaceChart, near: np.ndarray, size_mm, n: int) -> np.ndarray:
    """Return heights of the surface over the piece's grid, NaN where there is none; refused if that is most of it."""
    reach = float(np.hypot(*size_mm)) / 2
    h = surface_chart.surface_heights(chart, near, size_mm, n, (-reach, reach))
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
    """Return the frame turned to the surface at its origin, and the curvature matrix 2×2 there along right and up
    (positive where the surface bulges outwards), from a quadratic fitted to the inner half of the surface under the
    piece.
    """
    curvatures = np.zeros((2, 2))
    for _ in range(2):
        st, h = _sample_surface(_chart(frame, frame.right, 0.0, 0.0), near, np.array(size_mm) / 2)
        s, t = st.T
        _, ds, dt, dss, dst, dtt = np.linalg.lstsq(np.stack([s**0, s, t, s**2, s * t, t**2], 1), h, rcond=None)[0]
        normal = frame.normal - ds * frame.right - dt * frame.up
        frame = _turn_frame(frame, normal / np.linalg.norm(normal), frame.origin_mm)
        curvatures = -np.array([[2 * dss, dst], [dst, 2 * dtt]])
    return frame, curvatures


def _fit_cylinder(
    near: np.ndarray, tangent: SurfaceFrame, curvatures: np.ndarray, size_mm, spin_deg: float
) -> SurfaceChart:
    """Fit a cylinder to the surface under the piece; its normal goes through the tangent frame's origin."""
    values, directions = np.linalg.eigh(curvatures)
    strongest = int(np.abs(values).argmax())
    across = directions[0, strongest] * tangent.right + directions[1, strongest] * tangent.up
    chart = _chart(tangent, across, float(values[strongest]), spin_deg)
    for share in (0.5, 1.0, 1.0):  # which surface lies under the piece depends on the cylinder
        st, h = _sample_surface(chart, near, np.array(size_mm) * share)
        chart = _refine_cylinder(chart, chart.world(st[:, 0], st[:, 1], h), tangent, size_mm, spin_deg)
        _refuse_overlap(chart, size_mm)
    return chart


def _refine_cylinder(
    chart: SurfaceChart, points_mm: np.ndarray, tangent: SurfaceFrame, size_mm, spin_deg: float
) -> SurfaceChart:
    """Return the chart turned (3 angles), moved along its normal and curved again so that points are near height 0."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    unit = float(np.hypot(*size_mm)) / 2  # scales millimeters and 1/mm to about 1

    def chart_at(x: np.ndarray) -> SurfaceChart:
        axes = Rotation.from_rotvec(x[:3] @ chart.axes).apply(chart.axes)
        facing = _turn_frame(tangent, axes[2], tangent.origin_mm)
        origin = tangent.origin_mm + x[3] * unit * axes[2]
        return SurfaceChart(origin, axes, x[4] / unit, axes[:2] @ spun_axes(facing, spin_deg)[0])

    start = np.array([0, 0, 0, 0, chart.curvature * unit])
    # dents and bumps weigh less than the surface that the paper will lie on
    close_mm = CLOSE_SHARE * min(size_mm)
    fit = least_squares(lambda x: chart_at(x).local(points_mm)[:, 2], start, loss="soft_l1", f_scale=close_mm)
    return chart_at(fit.x)


def _fit_polynomial(chart: SurfaceChart, near: np.ndarray, size_mm) -> SmoothSurface:
    """Return the chart with a polynomial fitted to the surface's heights over it."""
    st, h = _sample_surface(chart, near, size_mm)
    s, t = st.T
    scale = float(np.hypot(*size_mm)) / 2
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    basis = np.stack([(s / scale) ** i * (t / scale) ** j for i, j in powers], 1)
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1))
    fit = np.linalg.lstsq(basis, h, rcond=None)[0]
    residual = h - basis @ fit
    _refuse_gap(float(residual.max() - residual.mean()), size_mm)  # geodesics on a poor fit may run away
    coefficients[tuple(np.transpose(powers))] = fit
    return SmoothSurface(chart, coefficients, scale)


def _lay_on(surface: SmoothSurface, near: np.ndarray, frame: SurfaceFrame, size_mm, spin_deg: float) -> Placement:
    """Place the piece on a smooth surface, raised until it is LIFT_MM clear of the triangles under it."""
    surface_h = _surface_heights(surface.chart, near, size_mm, GRID)
    faces = grid_faces(PIECE_GRID)
    surface = surface.raise_by(_highest(surface, near, surface_h, size_mm) + LIFT_MM)
    _, st = _map_grid(surface, frame, size_mm, spin_deg)
    paper = surface_chart.surface_heights(surface.chart, surface.points_and_normals(*st.T)[0][faces], size_mm, GRID)
    grid_st = piece_grid(size_mm, GRID) @ surface.chart.turn
    # flat cells cut below a round surface
    surface = surface.raise_by(max(0.0, float(np.nanmax(surface.height(*grid_st.T) - paper))))
    world_from_piece, st = _map_grid(surface, frame, size_mm, spin_deg)
    vertices, normals = surface.points_and_normals(*st.T)
    paper = surface_chart.surface_heights(surface.chart, vertices[faces], size_mm, GRID)
    # a cell's chords end short of a round surface's edge
    clearance = np.where(np.isfinite(paper), paper, surface.height(*grid_st.T)) - surface_h
    gaps = clearance[np.isfinite(clearance) & np.isfinite(paper)] - LIFT_MM
    return Placement(
        family="exponential",
        size_mm=tuple(size_mm),
        vertices_mm=vertices,
        faces=faces,
        piece_mm=piece_grid(size_mm, PIECE_GRID) * [1, -1] + np.array(size_mm) / 2,
        normals=normals,
        world_from_piece=world_from_piece,
        gap_mm=float(gaps.max()),
        gap_mean_mm=float(gaps.mean()),
        gaps_mm=(clearance - LIFT_MM).reshape(GRID, GRID),
        overhang_share=1 - len(gaps) / int(np.isfinite(paper).sum()),
        stretch=float(grid_stretch(surface, st, size_mm, PIECE_GRID).max()),
        reason="",
    )


def _highest(surface: SmoothSurface, near: np.ndarray, surface_h: np.ndarray, size_mm) -> float:
    """Return the greatest height under the piece over the smooth surface; ridges lie along edges, which grids miss."""
    ridges = surface.chart.local(surface_chart.edge_points(near, float(np.hypot(*size_mm)) / GRID))
    inside = (np.abs(ridges[:, :2] @ surface.chart.turn.T) <= np.array(size_mm) / 2).all(1)
    inside &= np.abs(ridges[:, 2]) <= np.hypot(*size_mm) / 2
    peaks = ridges[inside, 2] - surface.height(*ridges[inside, :2].T)
    grid_heights = surface_h - surface.height(*(piece_grid(size_mm, GRID) @ surface.chart.turn).T)
    return float(max(np.nanmax(grid_heights), peaks.max(initial=-np.inf)))


def _map_grid(surface: SmoothSurface, frame: SurfaceFrame, size_mm, spin_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the 4×4 world from piece of its tangent plane, and (s, t) of its grid; refused if these run away."""
    middle, normal = (a[0] for a in surface.points_and_normals(np.zeros(1), np.zeros(1)))
    right, up = spun_axes(_turn_frame(frame, normal, middle), spin_deg)
    with np.errstate(all="ignore"):
        st = exponential_map(surface, piece_grid(size_mm, PIECE_GRID), right, up)
    if not (np.abs(st) < 2 * np.hypot(*size_mm)).all():
        raise Refused("a surface that paper can follow", "a surface that folds under the piece", _REMEDY)
    return piece_pose(right, up, normal, middle, size_mm), st


def grid_faces(n: int) -> np.ndarray:
    """Return two triangles per cell of an n×n grid by rows from the top, counter-clockwise as one faces it."""
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    return np.concatenate([corner + np.array([0, n, n + 1]), corner + np.array([0, n + 1, 1])])


def _refuse_overlap(chart: SurfaceChart, size_mm) -> None:
    around = 2 * np.pi / max(abs(chart.curvature), 1e-9)
    wrapped = float(np.abs(chart.turn[:, 0]) @ np.array(size_mm))
    if wrapped > around:
        got = f"{wrapped:.0f} mm of piece around a best cylinder of {around:.0f} mm"
        raise Refused("a surface on which the piece does not overlap itself", got, _REMEDY)


def _refuse_overhang(piece: Placement) -> None:
    if piece.overhang_share > OVERHANG_LIMIT:
        expected = f"a surface under at least {1 - OVERHANG_LIMIT:.0%} of a bent piece"
        raise Refused(expected, f"a surface under {1 - piece.overhang_share:.0%} of it", _REMEDY)


def _refuse_gap(gap_mean_mm: float, size_mm) -> None:
    if gap_mean_mm > GAP_LIMIT * min(size_mm):
        expected = f"a surface that paper stands off by at most {GAP_LIMIT:.0%} of its shorter edge on average"
        got = f"an edge, bump, hole or handle that keeps it {gap_mean_mm:.1f} mm off ({gap_mean_mm / min(size_mm):.0%})"
        raise Refused(expected, got, _REMEDY)
