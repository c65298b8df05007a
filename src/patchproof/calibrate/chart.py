"""Calibrate a printer from photographs of its printed chart.

In: photographs of one or several prints of a page with a chart, and its manifest. Out: a `Printer` whose provenance
holds every rung of the ladder, every photograph and how much they disagree. Light relative to paper is averaged over
the photographs of a print (their median from three on), then over prints.

The table is an *appearance* model: what this camera showed of this printer in that light, decoded as sRGB. A photograph
shows the product of the tone curves of camera and printer, and nothing on the page separates them.

The page is found by its markers, and swatches are read in their unblurred cores, in linear light, over the smooth
surface that `paper_light` fits to white paper around the chart and to white swatches: that cancels gradients,
vignetting, exposure and white balance. Text and lines on the paper are outliers of that surface. Left out on purpose:
lens distortion (a swatch's core is far from its border), and gloss: photograph without shine.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.color import LINEAR_FROM_CODE, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.input import hash_file, is_file, is_folder
from patchproof.base.progress import Advance, no_advance
from patchproof.calibrate.ladder import WELL_SPREAD_WIDTH, ColorMap, MapChoice, choose_map, color_difference, map_kinds
from patchproof.channel.printer import Printer, load_printer, node_colors, printer_from_table, printer_output
from patchproof.photo.detect import is_mirrored
from patchproof.photo.known_page import find_sheet
from patchproof.photo.limits import run_limited
from patchproof.photo.paper_light import paper_light, quadratic_terms
from patchproof.photo.quality import CLIPPED_CODE, blur_px
from patchproof.photo.read import Photo, list_images, read_photo, subfolders, summarize_said
from patchproof.photo.rectify import fit_page
from patchproof.photo.rejection import MIRRORED_ADVICE, PhotoRejected
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.piece import marker_rect
from patchproof.sheets.rects import RectMm, rect_contains

PRIORS = ("coated", "uncoated")
MIN_SWATCHES = 4  # paper, black and two others
MAX_PHOTO_DELTA_E00 = 5.0  # from its print's other photographs: more than light or camera can explain
MIN_CORE_PX = 4.0  # a swatch's side between blurred borders
MAX_CLIPPED_SHARE = 0.05  # share of white paper at full white; beyond it, its light is unknown
# of paper's light: below, noise that is cut off at 0 lifted black of .13 in sRGB to .17 (0.09) and .23 (0.05)
_LEAST_PAPER = 0.12
_LEAST_CHROMA = 0.05  # in linear light, between the channels of the most colorful swatch: saturated inks have 0.5
_CORE_MARGIN = 0.2  # of a swatch's side: the least margin on each side
_SAMPLES = 15  # along each side of a core
_SEARCH_MM = 60.0  # bare paper is searched for within this distance of the chart


@dataclass(frozen=True)
class ChartPhoto:
    """Swatches' `light` N×3 relative to paper (NaN: unread), and that of bare `paper` (1 = the camera's full white)."""

    light: np.ndarray
    paper: tuple[float, float, float]


@dataclass(frozen=True)
class PrinterCalibration:
    """The printer, the choice of its model, and warnings about the photographs."""

    printer: Printer
    choice: MapChoice
    warnings: tuple[str, ...]


def calibrate_chart(
    prints: Sequence[Sequence[Path]], manifest: Manifest, name: str, advance: Advance = no_advance
) -> PrinterCalibration:
    """Calibrate the printer from photographs; each inner list holds those of one print."""
    readings, warnings = _read_all(prints, manifest, advance)
    by_print = {number: combine_light([chart.light for _, chart in group]) for number, group in readings.items()}
    light = combine_light(list(by_print.values()), robust=False)
    sent = np.array([swatch.srgb for swatch in manifest.chart])
    usable = np.all(np.isfinite(light), axis=1)
    if usable.sum() < MIN_SWATCHES:
        do = "photograph the whole chart from closer, sharp and not overexposed"
        raise Refused(f"at least {MIN_SWATCHES} readable swatches", f"{usable.sum()}", do)
    if np.ptp(light[usable], axis=1).max() < _LEAST_CHROMA:
        do = "switch black and white off, in the printer's settings and the camera's"
        raise Refused("photographs of a chart in color", "gray ones", do)
    choice = choose_map(map_kinds(known_printers()), sent[usable], srgb_from_linear(light[usable]))
    photographs = []
    for number, group in readings.items():
        for path, chart in group:
            off = _difference(chart.light, by_print[number]) if len(group) > 1 else None
            paper = [round(value, 3) for value in chart.paper]
            row = {"file": path.name, "sha256": hash_file(path), "print": number, "paper": paper}
            photographs.append(row | {"delta_e00_from_print": off})
            if off is not None and off > MAX_PHOTO_DELTA_E00:
                differs = f"{path.name} differs from the other photographs of its print by ΔE00 {off:.1f}"
                warnings.append(f"{differs}: glare, or another print?")
    if choice.width < WELL_SPREAD_WIDTH:
        warnings.append(
            f"the {choice.colors} readable swatches hardly spread over the color cube ({choice.width:.2f} in their "
            f"thinnest direction, whole charts 0.3): errors are stated for colors like these, others are a guess"
        )
    count, between = len(by_print), [_difference(each, light) for each in by_print.values()]
    provenance = {
        "source": f"{len(photographs)} photographs of {count} print{'s' * (count > 1)} of a chart",
        "model_of": "appearance: printer and camera tone together, as this camera shows the print",
        "sheet_id": manifest.sheet_id,
        "relative_to": "paper: sRGB white is seen as bare paper",
        "chosen": choice.chosen.name,
        "ladder": [asdict(rung) for rung in choice.rungs],
        "not_tried": list(choice.left_out),
        "swatches": {"colors": choice.colors, "held_out": choice.held_out, "unreadable": int((~usable).sum())},
        "delta_e00_of_prints": between if count > 1 else None,
        "photographs": photographs,
        "uncertainty": f"mean ΔE00 {choice.chosen.error:.2f} of {choice.held_out} held-out colors of the chart",
    }
    return PrinterCalibration(printer_of(name, choice.predict, provenance), choice, tuple(warnings))


def prints_of(paths: Sequence[Path]) -> list[list[Path]]:
    """Group photographs by print: each folder holds those of one print; single files all show one."""
    singles, prints = [path for path in paths if not is_folder(path)], []
    for folder in (path for path in paths if is_folder(path)):
        prints.append(list_images(folder))
        if not prints[-1]:
            do = "name its folders, one for each place or print" if subfolders(folder) else "name the photographs"
            raise Refused("a folder with photographs of one print", f"none in {folder} itself", do)
    for path in singles:
        if not is_file(path):
            raise Refused("a photograph of the chart", f"no file at {path}", "check the path")
    return ([singles] if singles else []) + prints


def known_printers() -> dict[str, ColorMap]:
    """The shipped printers as maps of N×3 sRGB."""
    return {name: partial(printer_output, load_printer(name)) for name in PRIORS}


def printer_of(name: str, predict: ColorMap, provenance: Mapping[str, Any]) -> Printer:
    """The table of a fitted map, scaled per channel so that white is bare paper."""
    nodes = node_colors()
    light = linear_from_srgb(np.clip(predict(nodes.reshape(-1, 3)), 0, 1.2))
    lut = srgb_from_linear(np.clip(light / np.maximum(light[-1], 0.1), 0, 1)).reshape(nodes.shape)
    gamut = color_difference(nodes.reshape(-1, 3), lut.reshape(-1, 3)).reshape(nodes.shape[:3])
    return printer_from_table(name, "measured", lut, gamut, dict(provenance))


def combine_light(readings: Sequence[np.ndarray], robust: bool = True) -> np.ndarray:
    """Average several readings of light N×3, NaN where none could be read; the median from three on, if `robust`."""
    stack = np.stack(readings)
    missing = np.isnan(stack).all(0)
    stack = np.where(missing, 0.0, stack)
    middle = np.nanmedian(stack, 0) if robust and len(readings) > 2 else np.nanmean(stack, 0)
    return np.where(missing, np.nan, middle)


def _difference(light: np.ndarray, mean: np.ndarray) -> float | None:
    """Mean ΔE00 of the readable swatches from others; None without any."""
    readable = np.isfinite(light).all(1)
    pair = (srgb_from_linear(each[readable]) for each in (light, mean))
    return round(float(color_difference(*pair).mean()), 2) if readable.any() else None


def summary_lines(calibration: PrinterCalibration) -> list[str]:
    """The choice with every rung's figure, for the terminal."""
    choice, provenance = calibration.choice, calibration.printer.provenance
    lines = [f"{provenance['source']}; {provenance['model_of']}"]
    chosen = "  <- chosen: the simplest within one standard error of the best"
    for rung in choice.rungs:
        difference = f"(+{rung.worse_by:.2f} ± {rung.standard_error:.2f}){chosen * (rung == choice.chosen)}"
        lines.append(f"  {rung.name:20s} ΔE00 {rung.error:5.2f}  {difference}")
    if choice.left_out:
        lines.append(f"not tried, since swatches are too few or too much alike: {', '.join(choice.left_out)}")
    lines.append(f"held out: {choice.held_out} of {choice.colors} colors in turn")
    differ = f"prints differ from their mean by ΔE00 {provenance['delta_e00_of_prints']}"
    lines.append(differ if provenance["delta_e00_of_prints"] else "how prints differ is not measured: only one")
    if unreadable := provenance["swatches"]["unreadable"]:
        lines.append(f"swatches that no photograph shows well enough: {unreadable}")
    return lines


def _read_all(
    prints: Sequence[Sequence[Path]], manifest: Manifest, advance: Advance
) -> tuple[dict[int, list[tuple[Path, ChartPhoto]]], list[str]]:
    """The photographs that can be read, by print from 1, and warnings about the others; refused if none is left."""
    if not manifest.chart:
        raise Refused("a sheet with a chart", f"sheet {manifest.sheet_id} without", "name the page's own JSON")
    readings, warnings, said = {}, [], []
    numbered = [(number, path) for number, paths in enumerate(prints, 1) for path in paths]
    for done, (number, path) in enumerate(numbered, 1):
        try:
            photo = read_photo(path)
            chart = run_limited(read_chart, photo, manifest)
            readings.setdefault(number, []).append((path, chart))
            said.append((path.name, photo.said))
        except PhotoRejected as rejection:
            warnings.append(f"{path.name} is left out ({rejection})")
        advance(done, len(numbered))
    if not readings:
        first = warnings[0] if warnings else "none given"
        expected = "photographs in which the chart can be read"
        raise Refused(expected, f"none of {len(numbered)}", f"see the first: {first}")
    return readings, warnings + summarize_said(said)


def read_chart(photo: Photo, manifest: Manifest) -> ChartPhoto:
    """Read the chart's swatches; raises `PhotoRejected` where there is none, or none that can be trusted."""
    srgb = photo.srgb
    page = px_from_mm, _ = _find_page(srgb, manifest)
    found = {row: _core(swatch.rect_mm, *page, srgb.shape) for row, swatch in enumerate(manifest.chart)}
    cores = {row: core for row, core in found.items() if core is not None}
    if not cores:
        raise PhotoRejected("too_small", 0, 1, "come closer to the chart, hold still and show all of it")
    light = np.full((len(manifest.chart), 3), np.nan)
    middles_mm = np.array([[x + w / 2, y + h / 2] for x, y, w, h in cores.values()])
    by_swatch = _paper_at(middles_mm, srgb, manifest, *page)
    grid = (np.indices((_SAMPLES, _SAMPLES)).reshape(2, -1).T + 0.5) / _SAMPLES
    for (row, core), paper in zip(cores.items(), by_swatch, strict=True):
        # nearest pixels, not mixtures: the mean of their light is the light's mean, whatever the tone curve
        px = np.floor(apply_homography(px_from_mm, core[:2] + np.multiply(core[2:], grid))).astype(int)
        column, line = np.clip(px, 0, [srgb.shape[1] - 1, srgb.shape[0] - 1]).T
        codes = srgb[line, column]
        if (codes >= CLIPPED_CODE).any(-1).mean() <= MAX_CLIPPED_SHARE:
            light[row] = LINEAR_FROM_CODE[codes].mean(0) / paper
    red, green, blue = np.median(by_swatch, 0).tolist()
    return ChartPhoto(light, (red, green, blue))


def _find_page(srgb: np.ndarray, manifest: Manifest) -> tuple[np.ndarray, float]:
    """Return the homography mm → px of the chart's page, and the blur in px: by the markers beside the piece, and by
    the piece's own as well if it is not cut out.
    """
    dictionary = manifest.markers[0].dictionary
    on_page = {marker.id: marker for marker in manifest.markers if marker.page == manifest.chart[0].page}
    corners_mm = {i: np.array(marker.corners_mm) for i, marker in on_page.items()}
    detected = find_sheet(srgb, corners_mm.keys(), corners_mm, dictionary)
    corners_px = detected.corners_px
    if not corners_px:
        if is_mirrored(srgb, detected, dictionary):
            raise PhotoRejected("mirrored", None, None, MIRRORED_ADVICE)
        if detected.another_sheet:
            advice = "these are the markers of another sheet or page: name that sheet's JSON, or leave the photo out"
            raise PhotoRejected("wrong_sheet", len(detected.foreign), 0, advice)
        raise PhotoRejected("too_few_markers", 0, 1, "no marker is readable: show the page sharp and well lit")
    beside = {i: px for i, px in corners_px.items() if not rect_contains(manifest.cut_mm, marker_rect(on_page[i]))}
    fit = fit_page(corners_px, corners_mm)
    if len(beside) > 1 and not set(beside) <= set(fit.inlier_ids):
        fit = fit_page(beside, corners_mm)
    return fit.px_from_mm, blur_px(detected.markers.values())


def _core(rect: RectMm, px_from_mm: np.ndarray, blur_px: float, shape) -> RectMm | None:
    """The part of a swatch that blur does not reach; None where there is none or it lies outside the picture."""
    x, y, w, h = rect
    quad = apply_homography(px_from_mm, rect_corners(rect))
    sides = np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1)
    sides = np.array([min(sides[0], sides[2]), min(sides[1], sides[3])])
    edge = np.maximum(_CORE_MARGIN, (0.75 + 1.5 * blur_px) / sides)
    in_picture = ((quad >= 0) & (quad <= [shape[1], shape[0]])).all()
    if (sides * (1 - 2 * edge) < MIN_CORE_PX).any() or not in_picture:
        return None
    return x + w * edge[0], y + h * edge[1], w * (1 - 2 * edge[0]), h * (1 - 2 * edge[1])


def _paper_at(points_mm, srgb: np.ndarray, manifest: Manifest, px_from_mm: np.ndarray, blur_px: float) -> np.ndarray:
    """The light N×3 of bare paper at points N×2, by the white paper around the chart and its white swatches."""
    rects = np.array([swatch.rect_mm for swatch in manifest.chart])
    low = np.maximum(rects[:, :2].min(0) - _SEARCH_MM, 0)
    high = np.minimum((rects[:, :2] + rects[:, 2:]).max(0) + _SEARCH_MM, manifest.page_mm)
    printed = [swatch.rect_mm for swatch in manifest.chart if min(swatch.srgb) < 1]
    printed += [marker_rect(m) for m in manifest.markers if m.page == manifest.chart[0].page]
    if any(not rect_contains(manifest.cut_mm, swatch.rect_mm) for swatch in manifest.chart):
        printed.append(manifest.cut_mm)
    area = (*low.tolist(), *(high - low).tolist())
    paper = paper_light(srgb, px_from_mm, area, printed, blur_px)
    light = quadratic_terms(points_mm - low, area[2:]) @ paper.coefficients.T
    if light.max() > (full := LINEAR_FROM_CODE[CLIPPED_CODE]) or light.min() <= 0:
        advice = "the paper is overexposed, or its light too uneven: lower the exposure by one step, in even light"
        raise PhotoRejected("clipped", float(light.max()), float(full), advice)
    if (dark := float(light.mean(1).min())) < _LEAST_PAPER:
        raise PhotoRejected("noisy", dark, _LEAST_PAPER, "the paper is too dark: use more light, or expose longer")
    return light
