"""Calibrate a printer from photographs of any print whose pixels are known: a patch, a poster, stickers.

In: photographs of a design by place, its manifest, and how it is located without markers. Out: a known printer's table,
moved to what the design's cells show as far as their colors reach. Ink and each photograph's veil, gains, tone and
chroma are fitted by `channel.print_colors`; what is left of cells is averaged over like colors. What all photographs
share is put into the ink, though it may be the phone's or the light's.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.color import ciede2000, lab_from_linear, linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_corners
from patchproof.base.progress import Advance
from patchproof.base.text import printable
from patchproof.base.workers import open_workers
from patchproof.calibrate.chart import PRIORS, printer_of
from patchproof.channel.print_colors import INK_TERMS, CellColors, ShownColors, add_ink, fit_ink_and_photos
from patchproof.channel.printer import Printer, load_printer, node_colors, printer_output
from patchproof.evidence.annotations import corners_of_photo, find_in_photos
from patchproof.evidence.batch import PhotoItem, measure_all
from patchproof.evidence.locate import pinhole_photo
from patchproof.evidence.measure import UNNAMED_ADVICE, MeasuredPhoto
from patchproof.evidence.reproject import unmix_markers
from patchproof.evidence.surface import (
    LEAST_CELLS,
    PhotographedDesign,
    choose_photo_cells,
    design_cells,
    printed_colors,
)
from patchproof.evidence.task import Options, Task, promised_ranges, task_of
from patchproof.photo.read import read_photo
from patchproof.photo.rectify import crop_around
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.markers import MARKER_MODULES

KNOWN_PRINTERS = ("office", *PRIORS)
COVERED_DELTA_E00, UNTOUCHED_DELTA_E00 = 10.0, 15.0  # from a seen color; between them the ink fades
_SHARED_VEIL = 0.03  # assumed to be in every place, for a figure
_LEAST_MODULE_PX = 1.75  # of markers: of paper beside 1.4 px, ink took a third of the light
_LAB_BIN, _NEIGHBORS = 3.0, 16  # like colors are one; of the nearest in CIELAB the nearest in ΔE00 are taken
_NO_PAPER = (
    "neither markers nor a cell within ΔE00 {:.0f} of white show the paper's light: grays may be off by ΔE00 10 to 16, "
    "whatever the uncertainty says; photograph a print with markers or with white in its design"
)
_LIKE_DELTA_E00, _LIKE_CELLS = 4.0, 4.0  # averages of what is left: their reach, and cells that count for half


def calibrate_design(
    places: Sequence[Sequence[Path]],
    manifest: Manifest,
    name: str,
    options: Options,
    known: Sequence[str],
    advance: Advance,
) -> tuple[Printer, tuple[str, ...]]:
    """Calibrate a printer from photographs of one design, each place's in an inner list; returns warnings, too. It is
    based on the `known` printer whose colors alone come nearest to the photographs'.

    Refused if no photograph resolves the design's cells, or if its colors are too few.
    """
    if manifest.design is None:
        raise Refused("a sheet with a design", f"{manifest.sheet_id} without one", "name the printed design's JSON")
    task, read, warnings = replace(task_of(manifest, options, None), ranges=promised_ranges(())), {}, []
    numbered = [(n, path, printable(f"{path.parent.name}/{path.name}")) for n, ps in enumerate(places) for path in ps]
    items = [PhotoItem(path, file) for _, path, file in numbered]
    if options.corners:
        sources = [(item.file, item.path) for item in items]
        corners, remaining = find_in_photos("corners", options.corners, corners_of_photo, sources)
        items = [replace(item, corners=px) for item, px in zip(items, corners, strict=True)]
        warnings += [f"corners of {name} are left out (it is none of these photographs)" for name in remaining]
    with open_workers() as workers:
        measured = measure_all(task, items, None, workers, None, lambda file, pictures: None, advance)
    for (number, path, file), item, photo in zip(numbered, items, measured, strict=True):
        if isinstance(design := _read_cells(task, path, photo), str):
            unnamed = options.corners and item.corners is None and photo.entry.code == "no_corners"
            warnings.append(f"{file} is left out ({UNNAMED_ADVICE if unnamed else design})")
        elif (first := read.setdefault(photo.entry.sha256, found := (file, number, design))) is not found:
            warnings.append(f"{file} is left out (its bytes are those of {first[0]})")
    if not read:
        got = f"none of {len(items)}"
        raise Refused("photographs that resolve the design's cells", got, f"see the first: {warnings[0]}")
    files, numbers, designs = zip(*read.values(), strict=True)
    pixels, cells = manifest.design.pixels(), {}
    for each in known:
        cells[each] = choose_photo_cells(designs, printed_colors(pixels, task.surface, load_printer(each)))
        if cells[each] is None:
            colors = len(np.unique(pixels.reshape(-1, 3) // 32, axis=0))
            do = "photograph a print of more colors, or the chart (patchproof sheet --template chart_a4)"
            raise Refused("a design of enough colors to tell a printer", f"{colors} that differ by an eighth", do)
    alone = {each: float(np.median(_errors(photos, np.zeros((INK_TERMS, 3))))) for each, photos in cells.items()}
    best = min(alone, key=lambda each: alone[each])
    photos, prior, count = cells[best], load_printer(best), len(set(numbers))
    ink, terms = fit_ink_and_photos(photos)
    errors, left_out = _errors(photos, ink), []
    for place in set(numbers) if count > 1 else ():
        others = [c for c, number in zip(photos, numbers, strict=True) if number != place]
        own = [c for c, number in zip(photos, numbers, strict=True) if number == place]
        left_out += _errors(own, fit_ink_and_photos(others)[0])
    veils = [_SHARED_VEIL * np.exp(c.start[3:6]) for c in photos]
    less_veil = [replace(c, seen=(c.seen - v) / (1 - _SHARED_VEIL)) for c, v in zip(photos, veils, strict=True)]
    veiled, _ = fit_ink_and_photos(less_veil)
    ends = linear_from_srgb(printer_output(prior, np.array([[0.0] * 3, [0.5] * 3])))
    black, gray = ciede2000(*(lab_from_linear(add_ink(ends, each)) for each in (ink, veiled)))

    seen = np.concatenate([c.promised for c in photos])
    from_paper = ciede2000(lab_from_linear(np.clip(seen, 0, 1)), lab_from_linear(np.ones(3)))
    if not any(design.anchored for design in designs) and from_paper.min() > COVERED_DELTA_E00:
        warnings.append(_NO_PAPER.format(from_paper.min()))
    light = np.concatenate([ShownColors.of_terms(t).undo(c.seen) for c, t in zip(photos, terms, strict=True)])
    rest = srgb_from_linear(np.clip(light, 0, 1)) - srgb_from_linear(add_ink(seen, ink))
    codes = printer_output(prior, node_colors().reshape(-1, 3))
    lab = lab_from_linear(linear_from_srgb(codes))
    apart, mean = _nearby(lab, seen, rest)
    near = np.clip((UNTOUCHED_DELTA_E00 - apart) / (UNTOUCHED_DELTA_E00 - COVERED_DELTA_E00), 0, 1)[:, None]
    shown = codes + near * (srgb_from_linear(add_ink(linear_from_srgb(codes), ink)) + mean - codes)
    one_of_volume = np.unique(np.round(lab / 5), axis=0, return_index=True)[1]
    covered = float((apart[one_of_volume] <= COVERED_DELTA_E00).mean())
    rounded = [np.concatenate([t[:3], np.exp(t[3:6]), t[6:]]).round(4).tolist() for t in terms]
    provenance: dict[str, Any] = {
        "source": f"{len(photos)} photographs of a known design in {count} place{'s' * (count > 1)}",
        "model_of": "appearance: what all photographs share, of printer, phone or light, is in the ink",
        "sheet_id": manifest.sheet_id,
        "relative_to": "paper: sRGB white is seen as bare paper",
        "known_printer": best,
        "delta_e00_of_known_printers_alone": ", ".join(f"{each} {error:.2f}" for each, error in alone.items()),
        "covered_share": round(covered, 3),
        "covered": f"{covered:.0%} of {best}'s colors, within ΔE00 {COVERED_DELTA_E00:g} of a seen one; others fade",
        "ambiguity": f"a shared veil of {_SHARED_VEIL} would change black by ΔE00 {black:.1f}, mid gray by {gray:.1f}",
        "uncertainty": f"ΔE00 {np.median(left_out or errors):.1f} of cells in the median photograph"
        + (" of a place that was left out" if left_out else "; one place does not show how places differ"),
        "photographs": [
            {"file": file, "place": number + 1, "delta_e00": round(error, 2)}
            | {"veil": t[:3], "gains": t[3:6], "tone": t[6:9], "chroma": t[9]}
            for file, number, error, t in zip(files, numbers, errors, rounded, strict=True)
        ],
    }
    return printer_of(name, lambda colors: shown, provenance), tuple(warnings)


def _read_cells(task: Task, path: Path, measured: MeasuredPhoto) -> PhotographedDesign | str:
    """Read a measured photograph's cells, or say why it shows none that can be trusted."""
    entry, geometry, light = measured.entry, measured.entry.geometry, measured.light
    if entry.status == "rejected" or entry.code not in (None, "cropped", "weak_ink"):
        return entry.remark.advice if entry.remark else entry.status
    if geometry is None or geometry.homography_px_from_mm is None or light is None or not measured.counted:
        return "photograph the piece alone, on something flat"
    srgb, rect = pinhole_photo(read_photo(path), task.camera).srgb, task.surface.rect_mm
    anchored, px_from_mm = geometry.located == "markers", np.array(geometry.homography_px_from_mm)
    surface = task.surface if anchored else task.surface.without_markers
    sides_mm = [float(np.ptp(surface.corners_mm[i], axis=0).min()) for i in surface.piece_ids if anchored]
    if sides_mm and (module_px := geometry.px_per_mm * min(sides_mm) / MARKER_MODULES) < _LEAST_MODULE_PX:
        return f"{module_px:.1f} px of a marker's cell are too few to read the light of paper: come closer"
    if (unmixed := unmix_markers(srgb, px_from_mm, geometry.blur_px, light, surface)) is None:
        return "its markers are blurred: hold still and come closer"
    part, to_part = crop_around(srgb, px_from_mm, rect_corners(rect), 4)
    design = PhotographedDesign(*design_cells(part, to_part, rect, unmixed[1]), unmixed[0], anchored)
    return design if design.readable >= LEAST_CELLS else f"only {design.readable} of its cells can be read"


def _errors(photos: Sequence[CellColors], ink: np.ndarray) -> list[float]:
    """Median ΔE00 of each photograph's cells, relative to paper, in its own best light."""
    errors = []
    for cells in photos:
        pair = cells.shown_in(ink).show(cells.ink_light(ink)), cells.seen
        lab = (lab_from_linear(np.clip(light / np.exp(cells.start[3:6]), 1e-6, 1)) for light in pair)
        errors.append(float(np.median(ciede2000(*lab))))
    return errors


def _nearby(lab: np.ndarray, seen: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """ΔE00 N from CIELAB N×3 to the nearest seen light M×3; like colors' mean of values M×3, near 0 if few."""
    from scipy.spatial import KDTree

    colors = lab_from_linear(seen)
    _, bins, counts = np.unique(np.round(colors / _LAB_BIN), axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(bins.ravel(), column) for column in np.hstack([colors, values]).T], 1)
    colors = sums[:, :3] / counts[:, None]
    index = np.reshape(KDTree(colors).query(lab, min(_NEIGHBORS, len(colors)))[1], (len(lab), -1))
    apart = ciede2000(lab[:, None], colors[index])
    weight = np.exp(-((apart / _LIKE_DELTA_E00) ** 2) / 2)
    total = (weight * counts[index]).sum(1)[:, None] + _LIKE_CELLS
    return apart.min(1), (weight[..., None] * sums[:, 3:][index]).sum(1) / total
