"""Paper that follows the surface: a flat card, an unrolled cylinder or an exponential map, the first that lies close.

In: a mesh, the frame a card would have, size and spin. Out: a `Placement` whose middle lies where the frame's normal
meets the surface. A cylinder is fitted to the surface under the piece (least squares, five parameters); paper rolls
around it without any stretch. Where it stands off too far, the surface becomes the cylinder plus a polynomial of degree
4, and the piece the exponential map of its middle. The polynomial stands for the paper's stiffness: it does not follow
facets or small dents. Whatever the family, the piece is lifted until it lies clear of the surface everywhere, and the
lift counts as gap. Left out on purpose: folds, cuts and darts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from patchproof.base.errors import Refused
from patchproof.mesh.exponential_map import SmoothSurface, exponential_map, grid_stretch
from patchproof.mesh.mesh import Mesh
from patchproof.mesh.surface_chart import (
    SurfaceChart,
    edge_points,
    piece_grid,
    surface_heights,
    surface_point,
    triangles_near,
)
from patchproof.scene.placement import (
    GRID,
    LIFT_MM,
    Placement,
    PlacementMethod,
    SurfaceFrame,
    lay_card,
    piece_pose,
    place_card,
    refuse_larger_than_side,
    spun_axes,
)

# Mean gap, as a share of the shorter edge, up to which a simpler family lies on the surface: 0.6 mm on 60 mm.
CLOSE_SHARE = 0.01
GAP_LIMIT = 0.03  # the same for the last family: a piece that stands farther off casts shadows that are not rendered
# Assumed: paper breaks at about 1 to 3 % of strain, so that this much is the most that it follows without wrinkles or
# tears (vinyl follows more); it is also how far lengths on the surface may differ from the sheet's.
STRETCH_LIMIT = 0.01
OVERHANG_LIMIT = 0.1  # of the area: what has nothing to stick to is no longer held in the fitted shape

_DO = "make the patch smaller, move it, or leave out bend"
_FIT_NET = 33  # heights are fitted on this many points along each edge
_PIECE_NET = 33  # vertices of a bent piece along each edge; odd, so that one is the middle
_DEGREE = 4


def placement_method(bend: bool) -> PlacementMethod:
    """How a piece is laid on a surface: bent along it, or as a flat card."""
    return place_bent if bend else place_card


def place_bent(mesh: Mesh, frame: SurfaceFrame, size_mm: tuple[float, float], spin_deg: float) -> Placement:
    """Lay a piece of `size_mm` along the surface, its middle where the frame's normal meets it and its up along the
    frame's; spin turns it clockwise as one faces it. Refused, in one sentence, where paper cannot follow.
    """
    triangles, axes = mesh.vertices[mesh.faces], np.stack([frame.right, frame.up, frame.normal])
    middle = surface_point(triangles, frame.origin_mm, axes)
    # paper ends half a diagonal from its middle, and nothing farther than that from its chart is under it
    near = triangles_near(triangles, middle, float(np.hypot(*size_mm)))
    reach = float(np.hypot(*size_mm)) / 2
    tangent, bends = _tangent(near, _facing(frame, frame.normal, middle), size_mm)
    close_mm = CLOSE_SHARE * min(size_mm)
    card = lay_card(near, tangent, size_mm, spin_deg, reach)
    if card.gap_mean_mm <= close_mm:
        _refuse_overhang(card)
        extent = np.ptp(mesh.vertices @ np.stack([tangent.right, tangent.up], 1), axis=0)
        refuse_larger_than_side(size_mm, spin_deg, extent)
        return replace(card, reason=f"the surface is flat: a card stands {card.gap_mean_mm:.2f} mm off it on average")
    chart = _cylinder(near, tangent, bends, size_mm, spin_deg)
    rolled = _laid(SmoothSurface(chart, np.zeros((1, 1)), 1.0), near, frame, size_mm, spin_deg)
    _refuse_overhang(rolled)
    if rolled.gap_mean_mm <= close_mm:
        radius_mm = 1 / max(abs(chart.curvature), 1e-6)
        reason = (
            f"a cylinder of radius {radius_mm:.0f} mm lies {rolled.gap_mean_mm:.2f} mm off the surface on average, "
            f"where a flat card would stand {card.gap_mean_mm:.1f} mm off"
        )
        return replace(rolled, family="cylinder", reason=reason)
    laid = _laid(_smooth(chart, near, size_mm), near, frame, size_mm, spin_deg)
    _refuse_gap(laid.gap_mean_mm, size_mm)
    if laid.stretch > STRETCH_LIMIT:
        expected = f"a surface that paper follows with a stretch of at most {STRETCH_LIMIT:.0%}"
        raise Refused(expected, f"one curved both ways, which stretches it by {laid.stretch:.1%}", _DO)
    reason = (
        f"paper that follows the surface is stretched by {laid.stretch:.2%} at most and lies {laid.gap_mean_mm:.2f} mm "
        f"off on average, where the best cylinder would stand {rolled.gap_mean_mm:.1f} mm off"
    )
    return replace(laid, reason=reason)


def curl_card(card: Placement, radius_mm: float) -> Placement:
    """A flat card whose left and right edges curl off the object, on a cylinder that touches it along its middle.

    Nothing is fitted to the surface, and nothing is refused: this is what badly glued paper does.
    """
    if not card.is_flat:
        raise Refused("a flat card to curl", f"a piece on a {card.family}", "leave out bend")
    across, into = card.world_from_piece[:3, [0, 2]].T
    points, width = piece_grid(card.size_mm, _PIECE_NET) * [1, -1] + np.array(card.size_mm) / 2, card.size_mm[0]
    scale = float(np.linalg.norm(across))  # a print may be larger than its millimeters say
    turn = (points[:, :1] - width / 2) * scale / radius_mm
    flat = np.concatenate([width / 2 + radius_mm / scale * np.sin(turn), points[:, 1:]], 1)
    lifted = radius_mm * (1 - np.cos(turn)) * into
    normals = -np.sin(turn) * across / scale - np.cos(turn) * into
    return replace(
        card,
        family="curled",
        vertices_mm=card.world(flat) - lifted,
        faces=_grid_faces(_PIECE_NET),
        piece_mm=points,
        normals=normals,
        reason=f"curled to a radius of {radius_mm:.0f} mm",
    )


def _facing(frame: SurfaceFrame, normal: np.ndarray, origin_mm: np.ndarray) -> SurfaceFrame:
    """The frame turned to a normal, its up kept as well as it can be."""
    up = frame.up - (frame.up @ normal) * normal
    if np.linalg.norm(up) < 0.2:  # up is the normal, almost: right is what is left to go by
        up = np.cross(normal, frame.right)
    up /= np.linalg.norm(up)
    return SurfaceFrame(np.cross(up, normal), up, normal, origin_mm, frame.extent_mm)


def _chart(frame: SurfaceFrame, across: np.ndarray, curvature: float, spin_deg: float) -> SurfaceChart:
    """A cylinder that touches the frame's plane at its origin, curved along `across` (a unit vector in that plane)."""
    axes = np.stack([across, np.cross(frame.normal, across), frame.normal])
    return SurfaceChart(frame.origin_mm, axes, curvature, axes[:2] @ spun_axes(frame, spin_deg)[0])


def _under(chart: SurfaceChart, near: np.ndarray, size_mm, n: int) -> np.ndarray:
    """Heights of the surface over the piece's net, NaN where there is none; refused where that is most of it."""
    reach = float(np.hypot(*size_mm)) / 2
    h = surface_heights(chart, near, size_mm, n, (-reach, reach))
    if np.isfinite(h).mean() < 0.5:
        raise Refused("a patch that lies on the object", "a surface under less than half of it", _DO)
    return h


def _sampled(chart: SurfaceChart, near: np.ndarray, size_mm) -> tuple[np.ndarray, np.ndarray]:
    """(s, t) and heights of the surface where there is any."""
    h = _under(chart, near, size_mm, _FIT_NET)
    hit = np.isfinite(h)
    return (piece_grid(size_mm, _FIT_NET) @ chart.turn)[hit], h[hit]


def _tangent(near: np.ndarray, frame: SurfaceFrame, size_mm) -> tuple[SurfaceFrame, np.ndarray]:
    """The frame turned to the surface at its origin, and the curvature matrix 2×2 there along right and up (positive
    where the surface bulges outwards): from a quadratic fitted to the inner half of what lies under the piece.
    """
    bends = np.zeros((2, 2))
    for _ in range(2):
        st, h = _sampled(_chart(frame, frame.right, 0.0, 0.0), near, np.array(size_mm) / 2)
        s, t = st.T
        _, ds, dt, dss, dst, dtt = np.linalg.lstsq(np.stack([s**0, s, t, s**2, s * t, t**2], 1), h, rcond=None)[0]
        normal = frame.normal - ds * frame.right - dt * frame.up
        frame = _facing(frame, normal / np.linalg.norm(normal), frame.origin_mm)
        bends = -np.array([[2 * dss, dst], [dst, 2 * dtt]])
    return frame, bends


def _cylinder(near: np.ndarray, tangent: SurfaceFrame, bends: np.ndarray, size_mm, spin_deg: float) -> SurfaceChart:
    """The cylinder that fits the surface under the piece best; its normal goes through the tangent frame's origin."""
    values, directions = np.linalg.eigh(bends)
    most = int(np.abs(values).argmax())
    across = directions[0, most] * tangent.right + directions[1, most] * tangent.up
    chart = _chart(tangent, across, float(values[most]), spin_deg)
    for share in (0.5, 1.0, 1.0):  # what lies under a piece is known once the cylinder is
        st, h = _sampled(chart, near, np.array(size_mm) * share)
        chart = _fitted(chart, chart.world(st[:, 0], st[:, 1], h), tangent, size_mm, spin_deg)
        _refuse_overlap(chart, size_mm)
    return chart


def _fitted(
    chart: SurfaceChart, points_mm: np.ndarray, tangent: SurfaceFrame, size_mm, spin_deg: float
) -> SurfaceChart:
    """The chart turned (3 angles), moved along its normal and curved anew, so that points are near height 0."""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    unit = float(np.hypot(*size_mm)) / 2  # millimeters and 1/mm are scaled to about 1

    def moved(x: np.ndarray) -> SurfaceChart:
        axes = Rotation.from_rotvec(x[:3] @ chart.axes).apply(chart.axes)
        facing = _facing(tangent, axes[2], tangent.origin_mm)
        origin = tangent.origin_mm + x[3] * unit * axes[2]
        return SurfaceChart(origin, axes, x[4] / unit, axes[:2] @ spun_axes(facing, spin_deg)[0])

    start = np.array([0, 0, 0, 0, chart.curvature * unit])
    # dents and bumps weigh less than what the paper will lie on
    fit = least_squares(
        lambda x: moved(x).local(points_mm)[:, 2], start, loss="soft_l1", f_scale=CLOSE_SHARE * min(size_mm)
    )
    return moved(fit.x)


def _smooth(chart: SurfaceChart, near: np.ndarray, size_mm) -> SmoothSurface:
    """The chart with a polynomial fitted to the surface's heights over it."""
    st, h = _sampled(chart, near, size_mm)
    s, t = st.T
    scale = float(np.hypot(*size_mm)) / 2
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    basis = np.stack([(s / scale) ** i * (t / scale) ** j for i, j in powers], 1)
    coefficients = np.zeros((_DEGREE + 1, _DEGREE + 1))
    fit = np.linalg.lstsq(basis, h, rcond=None)[0]
    off = h - basis @ fit
    _refuse_gap(float(off.max() - off.mean()), size_mm)  # a poor fit may be too wild to walk on
    coefficients[tuple(np.transpose(powers))] = fit
    return SmoothSurface(chart, coefficients, scale)


def _laid(surface: SmoothSurface, near: np.ndarray, frame: SurfaceFrame, size_mm, spin_deg: float) -> Placement:
    """The piece on a smooth surface, lifted until it is LIFT_MM clear of the triangles under it."""
    under = _under(surface.chart, near, size_mm, GRID)
    faces = _grid_faces(_PIECE_NET)
    surface = surface.lifted(_top(surface, near, under, size_mm) + LIFT_MM)
    _, st = _spread(surface, frame, size_mm, spin_deg)
    paper = surface_heights(surface.chart, surface.points_and_normals(*st.T)[0][faces], size_mm, GRID)
    at = piece_grid(size_mm, GRID) @ surface.chart.turn
    # flat cells dip below a round surface
    surface = surface.lifted(max(0.0, float(np.nanmax(surface.height(*at.T) - paper))))
    pose, st = _spread(surface, frame, size_mm, spin_deg)
    vertices, normals = surface.points_and_normals(*st.T)
    paper = surface_heights(surface.chart, vertices[faces], size_mm, GRID)
    # a cell's chords end short of a round surface's edge
    clear = np.where(np.isfinite(paper), paper, surface.height(*at.T)) - under
    gaps = clear[np.isfinite(clear) & np.isfinite(paper)] - LIFT_MM
    stretches = grid_stretch(surface, st, size_mm, _PIECE_NET)
    return Placement(
        family="exponential",
        size_mm=tuple(size_mm),
        vertices_mm=vertices,
        faces=faces,
        piece_mm=piece_grid(size_mm, _PIECE_NET) * [1, -1] + np.array(size_mm) / 2,
        normals=normals,
        world_from_piece=pose,
        gap_mm=float(gaps.max()),
        gap_mean_mm=float(gaps.mean()),
        gaps_mm=(clear - LIFT_MM).reshape(GRID, GRID),
        overhang_share=1 - len(gaps) / int(np.isfinite(paper).sum()),
        stretch=float(stretches.max()),
        stretches=stretches,
        reason="",
    )


def _top(surface: SmoothSurface, near: np.ndarray, under: np.ndarray, size_mm) -> float:
    """How far the highest point under the piece stands over the surface; ridges lie along edges, and nets miss them."""
    ridges = surface.chart.local(edge_points(near, float(np.hypot(*size_mm)) / GRID))
    inside = (np.abs(ridges[:, :2] @ surface.chart.turn.T) <= np.array(size_mm) / 2).all(1)
    inside &= np.abs(ridges[:, 2]) <= np.hypot(*size_mm) / 2
    peaks = ridges[inside, 2] - surface.height(*ridges[inside, :2].T)
    sampled = under - surface.height(*(piece_grid(size_mm, GRID) @ surface.chart.turn).T)
    return float(max(np.nanmax(sampled), peaks.max(initial=-np.inf)))


def _spread(surface: SmoothSurface, frame: SurfaceFrame, size_mm, spin_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """4×4 world from piece of the plane tangent at its middle, (s, t) of its net; refused where geodesics run away."""
    middle, normal = (a[0] for a in surface.points_and_normals(np.zeros(1), np.zeros(1)))
    right, up = spun_axes(_facing(frame, normal, middle), spin_deg)
    with np.errstate(all="ignore"):
        st = exponential_map(surface, piece_grid(size_mm, _PIECE_NET), right, up)
    if not (np.abs(st) < 2 * np.hypot(*size_mm)).all():
        raise Refused("a surface that paper can follow", "one that folds under the piece", _DO)
    return piece_pose(right, up, normal, middle, size_mm), st


def _grid_faces(n: int) -> np.ndarray:
    """Two triangles per cell of an n×n grid by rows from the top, counter-clockwise as one faces it."""
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    return np.concatenate([corner + np.array([0, n, n + 1]), corner + np.array([0, n + 1, 1])])


def _refuse_overlap(chart: SurfaceChart, size_mm) -> None:
    around = 2 * np.pi / max(abs(chart.curvature), 1e-9)
    wrapped = float(np.abs(chart.turn[:, 0]) @ np.array(size_mm))
    if wrapped > around:
        got = f"{wrapped:.0f} mm of piece around a best cylinder of {around:.0f} mm"
        raise Refused("a surface on which the piece does not overlap itself", got, _DO)


def _refuse_overhang(laid: Placement) -> None:
    if laid.overhang_share > OVERHANG_LIMIT:
        expected = f"a surface under at least {1 - OVERHANG_LIMIT:.0%} of a bent piece"
        raise Refused(expected, f"{1 - laid.overhang_share:.0%}", _DO)


def _refuse_gap(gap_mean_mm: float, size_mm) -> None:
    if gap_mean_mm > GAP_LIMIT * min(size_mm):
        raise Refused(
            f"a surface that paper can lie on, off it by at most {GAP_LIMIT:.0%} of its shorter edge on average",
            f"an edge, bump, hole or handle that keeps it {gap_mean_mm:.1f} mm off ({gap_mean_mm / min(size_mm):.0%})",
            _DO,
        )
