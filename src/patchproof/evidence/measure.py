"""One photograph against the printed surface: where it was taken from, how sharp, how far its colors are off.

In: a `PinholePhoto`, the `Surface`, its `PromisedColors` look, and what the promise covered. Out: a `PhotoEntry` and pictures for
the report. Every figure that can be had is filled in even where a later step fails. A photograph is `rejected` only
for reasons that do not depend on the view (plus: outside of the promised ranges); where the sheet is identified but
geometry or color cannot be trusted it is `judged`: recognition still counts, since far and oblique views fail first
and leaving them out would flatter.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial

import numpy as np

from patchproof.base.geometry import MM_PER_INCH, apply_homography, rect_corners
from patchproof.evidence.appearance import MOST_CLIPPED, appearance
from patchproof.evidence.camera import PinholePhoto
from patchproof.evidence.locate import MOST_SHIFT, LocatedSheet, camera_pose, geometry_of, object_box, place
from patchproof.evidence.ranges import PromisedRanges
from patchproof.evidence.results import Geometry, PhotoEntry, Remark, Scale
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.photo.detect import MarkersInView, find_markers, is_mirrored
from patchproof.photo.known_page import complete_markers, find_sheet
from patchproof.photo.page_code import read_page_code, refuse_other_page
from patchproof.photo.quality import FrameLight, frame_light
from patchproof.photo.rectify import PageFit
from patchproof.photo.rejection import PhotoRejected

MOST_BLUR = 0.5  # modules of Gaussian sigma: beyond it borders of neighboring cells melt together
SMALLEST_DESIGN_PX = 24.0  # shorter side: fewer pixels cannot tell a design from its mean color
MOST_TILT_DEG = 78.0  # foreshortened to a fifth
MOST_UNCERTAIN = 0.03  # corner uncertainty as a share of the design's shorter side,
MOST_UNCERTAIN_MM = 1.5  # and never more than this: what counts as measured should not be 2 mm off
MOST_RESIDUAL = 0.01  # of the design's shorter side: flat sheets stay below 0.3 %, lenses of phones too
# The part of it that is no noise. Corners of the design miss up to 4.5 times as much. What is called rolled or behind a
# lens has no business to leave any: of folds by 10° that a cylinder explains best, it is 0.0008.
MOST_BEND, MOST_BEND_UNROLLED = 0.002, 0.0004
MOST_ODD = 0.004  # of a marker that does not agree: a shadow's edge moves one by 0.2 %, folded corners by 1 % and more
_CURLED_OFF = 0.1  # of the piece's diagonal: how far off its place curling takes a marker of the page
_LEAST_AGREEING = 3  # markers: each has a slope of its own, so that three do not fit a plane where paper is bent
MOST_SCALE_ERROR = 0.01
_MOST_PERSPECTIVE = 0.005  # of a scan: relative change of length between opposite sides; scanners have none
_SIZES = (0.8, 1.25)  # prints off by more than this are no prints of this page
_COME_CLOSER = "come closer or use the camera's full resolution"
_SQUARELY = "look at the patch more squarely: so far from the side its cells are too narrow"
_FEW = "show more of the piece: its markers fix where it lies"
_FEW_AGREE = "too few markers agree to tell flat paper from bent: show all of the piece"
_BENT = "the markers lie neither in a plane nor on rolled paper: press the sheet flat and show all of it"
_BENT_ANEW = (
    "the markers do not lie as on paper that is rolled in one direction: show all of the piece from nearer to the "
    "middle of its bend, and glue down what stands off the surface"
)
_SHIFTED = (
    "the design lies elsewhere than its markers say, on paper that is bent between them: press it down on its surface"
)
_HIDDEN = "a corner of the design is covered, folded away or out of the picture: show all of it"


@dataclass(frozen=True)
class MeasuredPhoto:
    """An entry without predictions, whether it is counted, pictures by kind, the light on the markers where it was
    read, and what the networks will see of it by side, where it was asked for.
    """

    entry: PhotoEntry
    counted: bool
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    light: FrameLight | None = None
    squares: dict[int, np.ndarray] | None = None


def measure(
    view: PinholePhoto,
    name: str,
    surface: Surface,
    promised: PromisedColors | None,
    ranges: PromisedRanges,
    scan_dpi: float | None = None,
    with_pictures: bool = True,
) -> MeasuredPhoto:
    """Everything that one readable photograph says; `promised` None leaves color unmeasured."""
    try:
        detected, surface = identify(view.srgb, surface)
    except PhotoRejected as cannot:
        return MeasuredPhoto(PhotoEntry(file=name, status="rejected", remark=Remark.of(cannot)), False)
    size_px = view.srgb.shape[1], view.srgb.shape[0]
    entry = partial(PhotoEntry, file=name, photo_px=size_px, markers_found=len(detected.markers))
    placed = place(view, detected, surface)
    if placed is None:
        advice = "the marker in view is distorted: show the whole patch"
        few = PhotoRejected("too_few_markers", len(detected.markers), 1, advice)
        return MeasuredPhoto(entry(status="judged", remark=Remark.of(few)), True)
    light = frame_light(view.srgb, detected.markers.values())
    fit = placed.fit
    geometry, corners = geometry_of(placed, detected, light, surface, promised)
    pose, focal = camera_pose(view, placed, surface)
    geometry = geometry.changed(focal=focal)
    entry = partial(entry, geometry=geometry, pose=pose, box=object_box(view, placed, surface))
    page_check = _is_uncut(placed, detected, surface)
    scale = None if scan_dpi is None else _scan_scale(fit.px_from_mm, surface, scan_dpi)
    counted = not page_check and scale is None
    trouble = _trouble(geometry, fit, detected, surface, corners)
    try:
        if page_check and surface.page_mm is not None:
            refuse_other_page(view.srgb, fit.px_from_mm, surface.page_mm, surface.label)
        if counted and (outside := ranges.violated(entry(status="judged"), trust_angles=trouble is None)) is not None:
            raise outside
    except PhotoRejected as cannot:
        return MeasuredPhoto(entry(status="rejected", remark=Remark.of(cannot)), False)
    color, pictures = None, {}
    # a page in tiles shows none of the piece's markers, or a part of them
    if trouble is None and promised is not None and surface.piece_ids:
        color, pictures = appearance(placed.srgb, fit.px_from_mm, surface, promised, light, geometry, with_pictures)
        if color.clipped_share > MOST_CLIPPED:
            advice = "the patch is overexposed: lower the exposure by one or two steps"
            trouble = PhotoRejected("clipped", color.clipped_share, MOST_CLIPPED, advice)
    if trouble is not None:
        entry = partial(entry, status="judged", remark=Remark.of(trouble))
    else:
        entry = partial(entry, status="measured", scale=scale, remark=_print_check(page_check, scale))
    return MeasuredPhoto(entry(color=color), counted, pictures, light)


def identify(srgb: np.ndarray, surface: Surface) -> tuple[MarkersInView, Surface]:
    """The sheet's markers and the surface they lie on: the whole, or one page of a piece in tiles. Raises
    `PhotoRejected` where none is seen, or where it is not clear which sheet it is.
    """
    wanted = surface.piece_ids or surface.page_ids
    if surface.pages:
        pages = [frozenset(page.corners_mm) for page in surface.pages]
        detected = find_markers(srgb, wanted, surface.all_ids, surface.dictionary, pages)
    else:
        detected = find_sheet(srgb, wanted, surface.corners_mm, surface.dictionary)
    if not detected.markers:
        if is_mirrored(srgb, surface.all_ids, surface.dictionary):
            advice = "the photo is mirrored: switch off the camera's mirror setting and save it again"
            raise PhotoRejected("mirrored", None, None, advice)
        label = read_page_code(srgb)
        if detected.foreign or (label is not None and label != surface.label):
            which = "another sheet" if label is None else f"sheet {label.sheet_id} ({label.content})"
            advice = f"this shows {which}: name that sheet's JSON, or leave the photo out"
            raise PhotoRejected("wrong_sheet", len(detected.foreign), 0, advice)
        raise PhotoRejected("too_few_markers", 0, 1, "no marker is readable: show the whole patch, sharp and well lit")
    if len(detected.foreign) > 1 or len(detected.doubled) > 1:
        others = max(len(detected.foreign), len(detected.doubled))
        raise PhotoRejected("several_sheets", others, 1, "more than one sheet is in view: photograph one at a time")
    if not surface.pages:
        return detected, surface
    surface = _page_in_view(detected, surface)
    ours = {i: borders for i, borders in detected.markers.items() if i in surface.corners_mm}
    detected = MarkersInView(ours, detected.foreign, detected.doubled)
    return complete_markers(srgb, detected, surface.corners_mm, surface.dictionary), surface


def _page_in_view(detected: MarkersInView, surface: Surface) -> Surface:
    """The page that most of the markers belong to which an assembled piece hides; the whole where there is none."""
    outside = detected.markers.keys() - surface.corners_mm.keys()
    hidden = [len(outside & page.corners_mm.keys()) for page in surface.pages]
    return surface.pages[int(np.argmax(hidden))] if any(hidden) else surface


def _is_uncut(placed: LocatedSheet, detected: MarkersInView, surface: Surface) -> bool:
    """Whether markers of the page are about where an uncut one has them; it may be curled beyond the piece."""
    if set(placed.fit.inlier_ids) & surface.page_ids or not detected.markers.keys() & surface.piece_ids:
        return True
    x, y, w, h = surface.rect_mm
    side_px = np.linalg.norm(np.diff(placed.px(placed.parameters, np.array([[x, y], [x + w, y + h]])), axis=0))
    off_px = [
        np.linalg.norm(detected.markers[i].corners_px - placed.px(placed.parameters, surface.corners_mm[i]), axis=1)
        for i in sorted(detected.markers.keys() & surface.page_ids)
    ]
    return any(off.max() < _CURLED_OFF * side_px for off in off_px)


def _trouble(
    geometry: Geometry, fit: PageFit, detected: MarkersInView, surface: Surface, corners: int = 4
) -> PhotoRejected | None:
    """Why geometry or color cannot be trusted, the nearest cause first; None where they can. The design shows itself in
    so many of its corners.
    """
    tilt, blur, residual = geometry.tilt_deg, geometry.blur_px, geometry.residual_mm
    side_mm, uncertainty = min(surface.rect_mm[2:]), geometry.corner_uncertainty_mm
    most_blur = MOST_BLUR * float(np.median([b.module_px for b in detected.markers.values()]))
    side_px, most_residual = side_mm * geometry.px_per_mm, MOST_RESIDUAL * side_mm
    agreeing, markers = len(fit.inlier_ids), len(detected.markers)
    least = min(_LEAST_AGREEING, len(surface.piece_ids) or 1)
    bent = residual > most_residual or agreeing < 0.5 * markers
    flat = geometry.homography_px_from_mm is not None
    bend, most_bend = geometry.bend_mm, (MOST_BEND if flat else MOST_BEND_UNROLLED) * side_mm
    shift, most_shift = geometry.design_shift_mm or 0.0, MOST_SHIFT * side_mm
    most_uncertain = min(MOST_UNCERTAIN * side_mm, MOST_UNCERTAIN_MM)
    uncertain = uncertainty > most_uncertain
    # foreshortened to cos(tilt); px_per_mm is the mean of both directions
    cosine = float(np.cos(np.radians(tilt)))
    small = _SQUARELY if side_px >= SMALLEST_DESIGN_PX * cosine**0.5 else _COME_CLOSER
    unsure = _SQUARELY if uncertainty * cosine <= most_uncertain else _COME_CLOSER
    curled = _BENT_ANEW if surface.bent else _BENT
    for wrong, code, figure, limit, advice in (
        (tilt > MOST_TILT_DEG, "tilted", tilt, MOST_TILT_DEG, "look at the patch less from the side"),
        (blur > most_blur, "blurred", blur, most_blur, "hold still, tap to focus on the patch, or use more light"),
        (side_px < SMALLEST_DESIGN_PX, "too_small", side_px, SMALLEST_DESIGN_PX, small),
        (agreeing < least, "too_few_markers", agreeing, least, _FEW_AGREE),
        (bent, "curled", residual, most_residual, curled),
        (bend > most_bend, "curled", bend, most_bend, curled),
        (fit.outlier_mm > MOST_ODD * side_mm, "curled", fit.outlier_mm, MOST_ODD * side_mm, curled),
        (uncertain and markers < 3, "too_few_markers", markers, 3, _FEW),
        (uncertain, "too_small", uncertainty, most_uncertain, unsure),
        (shift > most_shift, "curled", shift, most_shift, _SHIFTED),
        (corners < 4, "too_few_markers", corners, 4, _HIDDEN),
    ):
        if wrong:
            return PhotoRejected(code, figure, limit, advice)
    return None


def _scan_scale(px_from_mm: np.ndarray, surface: Surface, scan_dpi: float) -> Scale | None:
    """The print's scale through the middle of the design, by the DPI that the user states (never the file's own claim);
    None where the picture is no scan: it has perspective or another resolution. Stretched prints are scans, too.
    """
    corners = apply_homography(px_from_mm, rect_corners(surface.rect_mm))
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    perspective = max(abs(sides[0] / sides[2] - 1), abs(sides[1] / sides[3] - 1))
    x, y, w, h = surface.rect_mm
    ends = np.array([[x, y + h / 2], [x + w, y + h / 2], [x + w / 2, y], [x + w / 2, y + h]])
    left, right, top, bottom = apply_homography(px_from_mm, ends)
    px_per_mm = scan_dpi / MM_PER_INCH
    scale_x, scale_y = (float(np.linalg.norm(px) / mm / px_per_mm) for px, mm in ((right - left, w), (bottom - top, h)))
    if perspective < _MOST_PERSPECTIVE and all(_SIZES[0] < scale < _SIZES[1] for scale in (scale_x, scale_y)):
        return Scale(scale_x=scale_x, scale_y=scale_y)
    return None


def _print_check(page_check: bool, scale: Scale | None) -> Remark | None:
    """What a photograph that is not counted says of the print; None for one that is."""
    if scale is not None:
        worst = max((scale.scale_x, scale.scale_y), key=lambda scale: abs(scale - 1))
        if abs(worst - 1) > MOST_SCALE_ERROR:
            advice = f'it is printed {worst:.3f} times its size: print again at 100 %, "actual size", not "fit to page"'
            return Remark(code="scale_off", figure=worst, threshold=MOST_SCALE_ERROR, advice=advice)
        return Remark(advice="a scan checks the print and is not counted")
    return Remark(advice="a photo of the uncut page checks the print and is not counted") if page_check else None
