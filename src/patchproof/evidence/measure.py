"""Measure one photograph of the printed surface: where it was taken from, its sharpness, its color differences.

In: a `PinholePhoto`, the `Surface`, its `PromisedColors`, and the ranges of the promise. Out: a `PhotoEntry` and
pictures for the report. Every figure that could be measured is filled in, even if a later step fails. A photograph is
`rejected` only for reasons that do not depend on the view, or if it is outside of the promised ranges. If the sheet is
identified but geometry or color cannot be trusted, it is `judged`: recognition still counts, since far and oblique
views fail first and leaving them out would raise the rate.
"""

import warnings
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from patchproof.base.color import photo_codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.geometry import MM_PER_INCH, apply_homography, rect_corners
from patchproof.evidence.appearance import MOST_CLIPPED, MOST_NOISE, DesignMatch, appearance
from patchproof.evidence.locate import MOST_SHIFT, PinholePhoto, camera_pose, geometry_of, locate_sheet, object_box
from patchproof.evidence.results import Geometry, PhotoEntry, Remark, Scale, Trace
from patchproof.evidence.surface import PromisedColors, Surface
from patchproof.evidence.task import PromisedRanges
from patchproof.photo.detect import MarkersInView, find_markers, is_mirrored
from patchproof.photo.known_page import complete_markers, find_sheet
from patchproof.photo.page_code import read_page_code, refuse_other_page
from patchproof.photo.pose import UNCONFIRMED_DEG
from patchproof.photo.quality import FrameLight, blur_px, frame_light
from patchproof.photo.rectify import PageFit
from patchproof.photo.registration import DesignCorners, place_design
from patchproof.photo.rejection import MIRRORED_ADVICE, PhotoRejected
from patchproof.photo.unroll import LocatedSheet, flat_sheet

MOST_BLUR = 0.5  # modules of Gaussian sigma: beyond it, borders of neighboring cells merge
SMALLEST_DESIGN_PX = 24.0  # shorter side: fewer pixels cannot tell a design from its mean color
MOST_TILT_DEG = 78.0  # foreshortened to a fifth
MOST_UNCERTAINTY = 0.03  # corner uncertainty as a share of the design's shorter side,
MOST_UNCERTAINTY_MM = 1.5  # and never more than this: a measured photograph should not be 2 mm off
MOST_RESIDUAL = 0.01  # of the design's shorter side: flat sheets stay below 0.3 %, also through lenses of phones
# The part of the residual that is no noise. Corners of the design are off by up to 4.5 times as much. A sheet that was
# unrolled must leave less: folds by 10° that a cylinder fits best leave 0.0008.
MOST_BEND, MOST_BEND_UNROLLED = 0.002, 0.0004
MOST_OUTLIER = 0.004  # offset of an outlier marker: a shadow's edge moves one by 0.2 %, folded corners by 1 % and more
_MOST_CURL = 0.1  # of the piece's diagonal: how far curling moves a marker of the page
_LEAST_AGREEING = 3  # markers: on bent paper each has its own slope, so that three do not fit a plane
MOST_SCALE_ERROR = 0.01
_MOST_PERSPECTIVE = 0.005  # of a scan: relative difference in length of opposite sides; scanners have none
_SCALE_RANGE = (1 / 1.15, 1.15)  # no print of this page lies outside of it, but a scan at another resolution does
_MOST_ASKEW_DEG = 3.0  # of a sheet in a scanner
_DISTORTED_ADVICE = "the marker in view is distorted: show the whole patch"
_COME_CLOSER_ADVICE = "come closer or use the camera's full resolution"
_SQUARELY_ADVICE = "look at the patch more squarely: so far from the side its cells are too narrow"
_FEW_MARKERS_ADVICE = "show more of the piece: its markers fix where it lies"
_FEW_AGREE_ADVICE = "too few markers agree to tell flat paper from bent: show all of the piece"
_NOT_FLAT_ADVICE = "the markers lie neither in a plane nor on rolled paper: press the sheet flat and show all of it"
_NOT_FLAT_PRINT_ADVICE = "the design does not lie as a flat print would: press it flat, and name its corners exactly"
_NOT_ROLLED_ADVICE = (
    "the markers do not lie as on paper that is rolled in one direction: show all of the piece from nearer to the "
    "middle of its bend, and glue down what stands off the surface"
)
_SHIFTED_ADVICE = "the design lies elsewhere than its markers say: press it down on its surface, or print it again"
_OTHER_DPI_ADVICE = (
    "it cannot be a scan at {:g} dpi, where its print would be {:.3f} × {:.3f} of its size, so no scale was measured: "
    "give --scan-dpi the scan's own, the same in both directions"
)
_NO_CORNERS_ADVICE = "this print has no markers, and nothing says where it is: add --find or --corners FILE"
UNNAMED_ADVICE = "--corners FILE does not name this photograph: add it there, or add --find"
_OTHER_CORNERS_ADVICE = "the design does not lie between the corners that were named: name them to a few pixels"
_PLAIN_ADVICE = "without markers a design without structure cannot be told from another one: print it with markers"
UNLOCATED_CODES = ("too_few_markers", "no_corners")
_NOISY_ADVICE = "too dark or noisy to compare colors; the rest counts: use more light, or come closer"
_HIDDEN_ADVICE = "a corner of the design is covered, folded away or out of the picture: show all of it"


@dataclass(frozen=True)
class MeasuredPhoto:
    """An entry without predictions, whether it is counted, pictures by kind, the light on the markers (None: unread),
    the networks' squares by their side in pixels (None: not made), and its trace (None: rejected).
    """

    entry: PhotoEntry
    counted: bool
    pictures: dict[str, np.ndarray] = field(default_factory=dict)
    light: FrameLight | None = None
    squares: dict[int, np.ndarray] | None = None
    trace: Trace | None = None


def measure(
    view: PinholePhoto,
    name: str,
    surface: Surface,
    promised: PromisedColors | None,
    ranges: PromisedRanges,
    scan_dpi: float | None = None,
    with_pictures: bool = True,
    corners: DesignCorners | None = None,
    find: np.ndarray | None = None,
) -> MeasuredPhoto:
    """Measure one readable photograph; color only if the sheet has `promised` colors. Where no marker can
    be read the design's `corners` locate it, or a search for its pixels `find`.
    """
    size_px, placed = view.srgb.shape[1::-1], None
    try:
        detected, surface = identify_sheet(view.srgb, surface)
    except PhotoRejected as rejection:
        if (corners or find is not None) and promised is not None and rejection.code in UNLOCATED_CODES:
            from patchproof.photo.find_design import find_design, refuse_other_order

            try:
                if corners is None and find is not None:
                    corners = find_design(view.srgb, find, surface.rect_mm[2:])
                elif corners is not None:
                    design = photo_codes_from_srgb(srgb_from_linear(promised.design))
                    refuse_other_order(view.srgb, design, surface.rect_mm[2:], corners.px)
            except PhotoRejected as not_found:
                rejection, corners = not_found, None
        if corners is None or promised is None or rejection.code not in UNLOCATED_CODES:
            return MeasuredPhoto(PhotoEntry(file=name, status="rejected", remark=Remark.of(rejection)), False)
        detected, surface = MarkersInView({}, (), ()), surface.without_markers
        placed = place_design(view.srgb, corners, surface.rect_mm, promised.design, promised.ink)
    entry = partial(PhotoEntry, file=name, photo_px=size_px, markers_found=len(detected.markers))
    flat = placed and flat_sheet(view.srgb, placed.fit, surface.rect_mm)
    location = flat or locate_sheet(view, detected, surface)
    if location is None:
        trouble = PhotoRejected("too_few_markers", len(detected.markers), 1, _DISTORTED_ADVICE)
        return MeasuredPhoto(entry(status="judged", remark=Remark.of(trouble)), True)
    markers = detected.markers.values()
    light, blur = (placed.light, placed.blur_px) if placed else (frame_light(view.srgb, markers), blur_px(markers))
    fit = location.fit
    geometry, found_corners, found = geometry_of(view, location, detected, light, blur, surface, promised)
    geometry = geometry.changed(located=corners.located) if placed and corners else geometry
    pose, focal = camera_pose(view, location, surface)
    told = geometry.changed(focal=focal)
    if focal == "contradicted":
        # a stretched print, a squeezed picture or a rolling shutter tilts a sheet that stands straight
        told = told.changed(tilt_deg=None, tilt_uncertainty_deg=None)
    elif focal not in ("confirmed", "calibrated"):
        told = told.changed(tilt_uncertainty_deg=float(np.hypot(geometry.tilt_uncertainty_deg or 0, UNCONFIRMED_DEG)))
    entry = partial(entry, geometry=told, pose=pose, box=object_box(view, location, surface))
    page_check = _is_uncut(location, detected, surface)
    scale = None if scan_dpi is None else _scan_scale(fit.px_from_mm, surface, scan_dpi / view.step)
    counted = not page_check and scale is None
    trouble = _trouble(geometry, fit, detected, surface, found_corners)
    color, pictures, match, noisy = None, {}, DesignMatch(), False
    try:
        if page_check and surface.page_mm is not None:
            refuse_other_page(view.srgb, fit.px_from_mm, surface.page_mm, surface.label)
        if counted and (outside := ranges.violated(entry(status="judged"), trust_angles=trouble is None)) is not None:
            raise outside
        # one page of a piece in tiles has none of the piece's markers, or some of them
        if promised is not None and surface.is_piece:
            seen = location.srgb, fit.px_from_mm, surface, promised, light, geometry, with_pictures and trouble is None
            color, pictures, match = appearance(*seen)
            noisy = (color.noise_delta_e00 or 0) > MOST_NOISE
            if trouble is None and color.clipped_share > MOST_CLIPPED:
                advice = "the patch is overexposed: lower the exposure by one or two steps"
                trouble = PhotoRejected("clipped", color.clipped_share, MOST_CLIPPED, advice)
            if placed and match.likeness is None and match.trouble is None:
                raise PhotoRejected("other_design", None, None, _PLAIN_ADVICE)
            trouble = match.trouble_beside(trouble, *found, noisy)
    except PhotoRejected as rejection:
        if corners is not None and corners.located == "corners" and rejection.code == "other_design":
            rejection = PhotoRejected("other_design", rejection.figure, rejection.threshold, _OTHER_CORNERS_ADVICE)
        return MeasuredPhoto(entry(status="rejected", remark=Remark.of(rejection)), False)
    if trouble is not None and trouble.code != "clipped":
        color = None
    if trouble is not None:
        entry = partial(entry, status="judged", remark=Remark.of(trouble))
    else:
        remark = _print_check(page_check, scale, scan_dpi) or match.weak_ink
        if remark is None and noisy and color is not None:
            remark = Remark(code="noisy", figure=color.noise_delta_e00, threshold=MOST_NOISE, advice=_NOISY_ADVICE)
        scale = scale if scale is not None and _SCALE_RANGE[0] < _worst(scale) < _SCALE_RANGE[1] else None
        entry = partial(entry, status="measured", scale=scale, remark=remark)
    return MeasuredPhoto(entry(color=color), counted, pictures, light)


def identify_sheet(srgb: np.ndarray, surface: Surface) -> tuple[MarkersInView, Surface]:
    """Find the sheet's markers and the surface they lie on: the piece, or one page of a piece in tiles.

    Raises `PhotoRejected` if no marker is readable, or if markers of another sheet or of several are in view.
    """
    marker_ids = surface.piece_ids or surface.page_ids
    if not marker_ids:
        raise PhotoRejected("no_corners", None, None, _NO_CORNERS_ADVICE)
    pages = [frozenset(page.corners_mm) for page in surface.pages]
    if pages:
        all_ids = frozenset(surface.corners_mm).union(*pages)
        detected = find_markers(srgb, marker_ids, all_ids, surface.dictionary, pages)
    else:
        detected = find_sheet(srgb, marker_ids, surface.corners_mm, surface.dictionary)
    if not detected.markers:
        if is_mirrored(srgb, detected, surface.dictionary):
            raise PhotoRejected("mirrored", None, None, MIRRORED_ADVICE)
        label = read_page_code(srgb)
        if detected.another_sheet or (label is not None and label != surface.label):
            which = "another sheet" if label is None else "sheet {} ({})".format(*label.split(":")[1:])
            advice = f"this shows {which}: name that sheet's JSON, or leave the photo out"
            raise PhotoRejected("wrong_sheet", len(detected.foreign), 0, advice)
        raise PhotoRejected("too_few_markers", 0, 1, "no marker is readable: show the whole patch, sharp and well lit")
    if detected.another_sheet or detected.doubled:
        advice = "more than one sheet is in view: photograph one at a time"
        raise PhotoRejected("several_sheets", max(len(detected.foreign), len(detected.doubled)), 1, advice)
    if not surface.pages:
        return detected, surface
    hidden_ids = detected.markers.keys() - surface.corners_mm.keys()  # those that an assembled piece would hide
    counts = [len(hidden_ids & page) for page in pages]
    surface = surface.pages[int(np.argmax(counts))] if any(counts) else surface
    markers = {i: borders for i, borders in detected.markers.items() if i in surface.corners_mm}
    detected = MarkersInView(markers, detected.foreign, detected.doubled)
    return complete_markers(srgb, detected, surface.corners_mm, surface.dictionary), surface


def _is_uncut(location: LocatedSheet, detected: MarkersInView, surface: Surface) -> bool:
    """Check whether markers of the page lie about where an uncut page has them; it may curl around the piece."""
    if not surface.corners_mm:
        return False
    if set(location.fit.inlier_ids) & surface.page_ids or not detected.markers.keys() & surface.piece_ids:
        return True
    x, y, w, h = surface.rect_mm
    side_px = np.linalg.norm(np.diff(location.shape.px(np.array([[x, y], [x + w, y + h]])), axis=0))
    off_px = [
        np.linalg.norm(detected.markers[i].corners_px - location.shape.px(surface.corners_mm[i]), axis=1)
        for i in sorted(detected.markers.keys() & surface.page_ids)
    ]
    return any(off.max() < _MOST_CURL * side_px for off in off_px)


def _trouble(
    geometry: Geometry, fit: PageFit, detected: MarkersInView, surface: Surface, corners: int = 4
) -> PhotoRejected | None:
    """The first reason not to trust geometry or color, or None; the design was found in `corners` of its corners."""
    tilt, blur, residual = geometry.tilt_deg or 0.0, geometry.blur_px, geometry.residual_mm
    side_mm, uncertainty = min(surface.rect_mm[2:]), geometry.corner_uncertainty_mm
    modules_px = [b.module_px for b in detected.markers.values()]
    most_blur = MOST_BLUR * float(np.median(modules_px)) if modules_px else np.inf  # then the design's cells decide
    side_px, most_residual = side_mm * geometry.px_per_mm, MOST_RESIDUAL * side_mm
    agreeing, markers = len(fit.inlier_ids), len(detected.markers)
    # two markers fit a plane on bent paper, too; then the design's own pixels say that it is flat up to its corners
    confirmed = corners == 4 and geometry.design_shift_mm is not None
    least = min(_LEAST_AGREEING - confirmed, len(surface.piece_ids) or bool(surface.corners_mm))
    bent = residual > most_residual or agreeing < 0.5 * markers
    flat = geometry.homography_px_from_mm is not None
    bend, most_bend = geometry.bend_mm, (MOST_BEND if flat else MOST_BEND_UNROLLED) * side_mm
    shift, most_shift = geometry.design_shift_mm or 0.0, MOST_SHIFT * side_mm
    most_uncertainty = min(MOST_UNCERTAINTY * side_mm, MOST_UNCERTAINTY_MM)
    uncertain = uncertainty > most_uncertainty
    # foreshortened to cos(tilt); px_per_mm is the mean of both directions
    cosine = float(np.cos(np.radians(tilt)))
    closer_advice = _SQUARELY_ADVICE if side_px >= SMALLEST_DESIGN_PX * cosine**0.5 else _COME_CLOSER_ADVICE
    uncertain_advice = _SQUARELY_ADVICE if uncertainty * cosine <= most_uncertainty else _COME_CLOSER_ADVICE
    advices = _NOT_ROLLED_ADVICE if surface.bent else _NOT_FLAT_ADVICE, _SHIFTED_ADVICE
    bent_advice, shifted_advice = advices if surface.corners_mm else 2 * (_NOT_FLAT_PRINT_ADVICE,)
    for fails, code, figure, limit, advice in (
        (tilt > MOST_TILT_DEG, "tilted", tilt, MOST_TILT_DEG, "look at the patch less from the side"),
        (blur > most_blur, "blurred", blur, most_blur, "hold still, tap to focus on the patch, or use more light"),
        (side_px < SMALLEST_DESIGN_PX, "too_small", side_px, SMALLEST_DESIGN_PX, closer_advice),
        (agreeing < least, "too_few_markers", agreeing, least, _FEW_AGREE_ADVICE),
        (bent, "curled", residual, most_residual, bent_advice),
        (bend > most_bend, "curled", bend, most_bend, bent_advice),
        (fit.outlier_mm > MOST_OUTLIER * side_mm, "curled", fit.outlier_mm, MOST_OUTLIER * side_mm, bent_advice),
        (shift > most_shift, "curled", shift, most_shift, shifted_advice),
        (uncertain and 0 < markers < 3, "too_few_markers", markers, 3, _FEW_MARKERS_ADVICE),
        (uncertain, "too_small", uncertainty, most_uncertainty, uncertain_advice),
        (corners < 4, "too_few_markers", corners, 4, _HIDDEN_ADVICE),
    ):
        if fails:
            return PhotoRejected(code, figure, limit, advice)
    return None


def _scan_scale(px_from_mm: np.ndarray, surface: Surface, scan_dpi: float) -> Scale | None:
    """Measure the print's scale through the middle of the design, by the DPI that the user states, not by the file's.
    None if the picture has perspective, or lies askew in it at no scale of a print, and so is no scan.
    """
    corners = apply_homography(px_from_mm, rect_corners(surface.rect_mm))
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    perspective = max(abs(sides[0] / sides[2] - 1), abs(sides[1] / sides[3] - 1))
    x, y, w, h = surface.rect_mm
    ends = np.array([[x, y + h / 2], [x + w, y + h / 2], [x + w / 2, y], [x + w / 2, y + h]])
    left, right, top, bottom = apply_homography(px_from_mm, ends)
    px_per_mm = scan_dpi / MM_PER_INCH
    scale_x, scale_y = (float(np.linalg.norm(px) / mm / px_per_mm) for px, mm in ((right - left, w), (bottom - top, h)))
    scale = Scale(scale_x=scale_x, scale_y=scale_y)
    askew_deg = abs((np.degrees(np.arctan2(*(right - left))) + 45) % 90 - 45)
    possible = askew_deg < _MOST_ASKEW_DEG or _SCALE_RANGE[0] < _worst(scale) < _SCALE_RANGE[1]
    return scale if perspective < _MOST_PERSPECTIVE and possible else None


def ruler_scale(measured_mm: tuple[float, float], printed_mm: tuple[float, float]) -> Scale:
    """The print's scale by its rulers as somebody measured them; refused if no print of this page has it."""
    x, y = (measured / printed for measured, printed in zip(measured_mm, printed_mm, strict=True))
    scale = Scale(scale_x=x, scale_y=y)
    if min(x, y) <= 0 or not _SCALE_RANGE[0] < _worst(scale) < _SCALE_RANGE[1]:
        expected = "lengths of about {:g} and {:g} mm, as printed".format(*printed_mm)
        raise Refused(expected, "{:g} and {:g} mm".format(*measured_mm), "measure both of them in millimeters")
    if abs(_worst(scale) - 1) > MOST_SCALE_ERROR:
        said = f"by its rulers the print has {x:.3f} × {y:.3f} of its size, and the promise is of the full size"
        warnings.warn(f'{said}: print again at 100 %, "actual size"', stacklevel=2)
    return scale


def _worst(scale: Scale) -> float:
    return max((scale.scale_x, scale.scale_y), key=lambda side: abs(np.log(side)))


def _print_check(page_check: bool, scale: Scale | None, scan_dpi: float | None) -> Remark | None:
    """Remark on the print by a photograph that is not counted: a scan or an uncut page; None for one that is."""
    if scale is not None:
        worst = _worst(scale)
        if not _SCALE_RANGE[0] < worst < _SCALE_RANGE[1]:
            advice = _OTHER_DPI_ADVICE.format(scan_dpi, scale.scale_x, scale.scale_y)
            return Remark(code="scale_off", figure=worst, threshold=_SCALE_RANGE[worst > 1], advice=advice)
        if abs(worst - 1) > MOST_SCALE_ERROR:
            advice = f'it is printed {worst:.3f} times its size: print again at 100 %, "actual size", not "fit to page"'
            return Remark(code="scale_off", figure=worst, threshold=MOST_SCALE_ERROR, advice=advice)
        return Remark(advice="a scan checks the print and is not counted")
    return Remark(advice="a photo of the uncut page checks the print and is not counted") if page_check else None
