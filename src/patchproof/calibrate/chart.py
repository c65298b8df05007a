"""Calibrate a printer from photographs of its printed chart.

In: photographs of one or several prints of a page with a chart, its manifest, the camera if it is known. Out: a
`Printer` whose provenance holds every rung of the ladder, every photograph and how much they disagree. Light relative
to paper is averaged over the photographs of a print (their median from three on), then over prints; differences between
prints are given as the parameters of `channel.printer.vary_print`.

Without the camera's tone curve the table is an *appearance* model: what this camera showed of this printer, decoded as
sRGB. Both curves are one product in a photograph, and nothing on the page separates them. With it, light is the page's
own, and the table is the printer's. Either describes the paper under the light it was photographed in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import hash_file, is_file, is_folder
from patchproof.base.progress import Advance, no_advance
from patchproof.base.validation import not_measured_lines
from patchproof.calibrate import color_ladder
from patchproof.calibrate.chart_photo import ChartPhoto, chart_rows, read_chart
from patchproof.calibrate.color_ladder import ColorMap, MapChoice, choose_map, color_difference, map_kinds
from patchproof.calibrate.printer_files import printer_from_table, printer_output
from patchproof.channel.lens import Camera
from patchproof.channel.printer import Printer, load_printer, node_colors, vary_print
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_images, read_photo, summarize_said
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import Manifest

PRIORS = ("coated", "uncoated")
MIN_SWATCHES = 4  # paper, black and two others
MAX_PHOTO_DELTA_E00 = 5.0  # from its print's other photographs: more than light or camera can explain


@dataclass(frozen=True)
class PhotoReading:
    """One photograph that could be read: its file, the number of its print (from 0), and the chart in it."""

    path: Path
    print_number: int
    chart: ChartPhoto


@dataclass(frozen=True)
class PrinterCalibration:
    """The printer, the choice of its model, and warnings about the photographs."""

    printer: Printer
    choice: MapChoice
    warnings: tuple[str, ...]


def calibrate_chart(
    prints: Sequence[Sequence[Path]],
    manifest: Manifest,
    name: str,
    camera: Camera | None = None,
    advance: Advance = no_advance,
) -> PrinterCalibration:
    """Calibrate the printer from photographs; each inner list holds those of one print."""
    readings, warnings = _read_all(prints, manifest, camera, advance)
    by_print = [
        combine_light([reading.chart.light for reading in readings if reading.print_number == i])
        for i in sorted({reading.print_number for reading in readings})
    ]
    light = combine_light(by_print, robust=False)
    sent = np.array([swatch.srgb for swatch in manifest.chart])
    usable = np.all(np.isfinite(light), axis=1)
    if usable.sum() < MIN_SWATCHES:
        do = "photograph the whole chart from closer, sharp and not overexposed"
        raise Refused(f"at least {MIN_SWATCHES} readable swatches", f"{usable.sum()}", do)
    choice = choose_map(map_kinds(known_printers()), sent[usable], srgb_from_linear(light[usable]))
    agreement = _agreement(readings, by_print)
    warnings += [
        f"{reading.path.name} differs from the other photographs of its print by ΔE00 {error:.1f}: glare, or another "
        "print?"
        for reading, error in zip(readings, agreement, strict=True)
        if error is not None and error > MAX_PHOTO_DELTA_E00
    ]
    if choice.width < color_ladder.WELL_SPREAD_WIDTH:
        warnings.append(
            f"the {choice.colors} readable swatches hardly spread over the color cube ({choice.width:.2f} in their "
            f"thinnest direction, whole charts 0.3): errors are stated for colors like these, others are a guess"
        )
    provenance = {
        "source": f"{len(readings)} photographs of {len(by_print)} print{'s' if len(by_print) > 1 else ''} of a chart",
        "model_of": model_of(camera),
        "camera": None if camera is None else camera.name,
        "sheet_id": manifest.sheet_id,
        "relative_to": "paper: sRGB white is seen as bare paper",
        "chosen": choice.chosen.name,
        "ladder": ladder_table(choice),
        "swatches": {"colors": choice.colors, "held_out": choice.held_out, "unreadable": _unreadable(manifest, usable)},
        "delta_e00_of_duplicates": _duplicates(sent[usable], light[usable]),
        "print_to_print": print_variation(by_print),
        "not_measured": _not_measured(by_print, readings, sent[usable]),
        "photographs": [_row(reading, error) for reading, error in zip(readings, agreement, strict=True)],
        "uncertainty": f"mean ΔE00 {choice.chosen.error:.2f} of {choice.held_out} held-out colors of the chart",
    }
    return PrinterCalibration(printer_of(name, choice.predict, provenance), choice, tuple(warnings))


def prints_of(paths: Sequence[Path]) -> list[list[Path]]:
    """Group photographs by print: each folder holds those of one print; single files all show one."""
    singles, prints = [path for path in paths if not is_folder(path)], []
    for folder in (path for path in paths if is_folder(path)):
        prints.append(list_images(folder))
        if not prints[-1]:
            raise Refused("a folder with photographs of one print", f"none in {folder}", "name the photographs")
    for path in singles:
        if not is_file(path):
            raise Refused("a photograph of the chart", f"no file at {path}", "check the path")
    return ([singles] if singles else []) + prints


def model_of(camera: Camera | None) -> str:
    """Text that says whether a table from this camera's photographs describes the printer or its appearance."""
    if camera is not None and camera.tone_light is not None:
        return "printer: the camera's tone curve is taken out"
    why = "no camera file" if camera is None else f"no tone_light in the camera file {camera.name}"
    return f"appearance: printer and camera tone together, as this camera shows the print ({why})"


def known_printers() -> dict[str, ColorMap]:
    """The shipped printers as maps of N×3 sRGB."""
    return {name: partial(printer_output, load_printer(name)) for name in PRIORS}


def printer_of(name: str, predict: ColorMap, provenance: Mapping[str, Any]) -> Printer:
    """The table of a fitted map, scaled per channel so that white is bare paper."""
    nodes = node_colors()
    light = linear_from_srgb(np.clip(predict(nodes.reshape(-1, 3)), 0, 1.2))
    white = np.maximum(light[-1], 0.1)
    lut = srgb_from_linear(np.clip(light / white, 0, 1)).reshape(nodes.shape)
    gamut = color_difference(nodes.reshape(-1, 3), lut.reshape(-1, 3)).reshape(nodes.shape[:3])
    return printer_from_table(name, "measured", lut, gamut, None, dict(provenance))


def combine_light(readings: Sequence[np.ndarray], robust: bool = True) -> np.ndarray:
    """Average several readings of light N×3, NaN where none could be read; the median from three on, if `robust`."""
    stack = np.stack(readings)
    missing = np.isnan(stack).all(0)
    stack = np.where(missing, 0.0, stack)
    middle = np.nanmedian(stack, 0) if robust and len(readings) > 2 else np.nanmean(stack, 0)
    return np.where(missing, np.nan, middle)


_PRINT_CHANGE = (0.04, 0.05, 0.004)  # typical differences of dot gain, density and veil between prints


def print_variation(prints: Sequence[np.ndarray]) -> dict[str, Any] | None:
    """Standard deviations between the light N×3 of several prints; None for a single print.

    Each print is described by `vary_print`'s dot gain, density and a gray veil relative to the mean of all; the
    swatches' ΔE00 from that mean is given too.
    Two prints give a rough figure, and differences between photographs are included.
    """
    if len(prints) < 2:
        return None
    from scipy.optimize import least_squares

    mean = combine_light(prints, robust=False)
    readable = np.isfinite(np.stack(prints)).all((0, 2))
    middle, changes, distances = torch.tensor(mean[readable].clip(0, 1)), [], []
    for light in prints:
        target = srgb_from_linear(light[readable])

        def residuals(change: np.ndarray, target: np.ndarray = target) -> np.ndarray:
            varied = vary_print(middle, torch.tensor([*change[:2], 0.0, *change[[2, 2, 2]]]))
            return (srgb_from_linear(varied.numpy()) - target).ravel()

        changes.append(least_squares(residuals, np.zeros(3), x_scale=_PRINT_CHANGE).x)
        distances.append(color_difference(target, srgb_from_linear(mean[readable])).mean())
    gain, density, lift = np.std(changes, axis=0, ddof=1)
    figures = {"delta_e00": np.mean(distances), "dot_gain_sd": gain, "density_sd": density, "black_lift_sd": lift}
    return {"prints": len(prints), **{key: round(float(value), 4) for key, value in figures.items()}}


def ladder_table(choice: MapChoice) -> list[dict[str, Any]]:
    """Each rung's figures as stored; rungs that had too few colors have a reason instead."""
    figures = {"delta_e00": "error", "worse_by": "worse_by", "standard_error": "standard_error"}
    rows: list[dict[str, Any]] = [
        {"rung": rung.name} | {key: round(getattr(rung, name), 3) for key, name in figures.items()}
        for rung in choice.rungs
    ]
    reason = "swatches too few or too much alike"
    return rows + [{"rung": name, "delta_e00": None, "reason": reason} for name in choice.left_out]


def summary_lines(calibration: PrinterCalibration) -> list[str]:
    """The choice with every rung's figure, for the terminal."""
    choice, provenance = calibration.choice, calibration.printer.provenance
    lines = [f"{provenance['source']}; {provenance['model_of']}"]
    chosen = "  <- chosen: the simplest within one standard error of the best"
    for row in provenance["ladder"]:
        mark = chosen if row["rung"] == choice.chosen.name else ""
        figure = row.get("reason")
        if figure is None:
            figure = f"ΔE00 {row['delta_e00']:5.2f}  (+{row['worse_by']:.2f} ± {row['standard_error']:.2f})"
        lines.append(f"  {row['rung']:20s} {figure}{mark}")
    lines.append(f"held out: {choice.held_out} of {choice.colors} colors in turn")
    spread = provenance["print_to_print"]
    if spread is not None:
        lines.append(f"prints differ from their mean by ΔE00 {spread['delta_e00']:.2f} ({spread['prints']} prints)")
    if unreadable := provenance["swatches"]["unreadable"]:
        lines.append(f"swatches that no photograph shows well enough: {unreadable}")
    return lines + not_measured_lines(provenance["not_measured"])


def _not_measured(by_print: Sequence[np.ndarray], readings: Sequence[PhotoReading], sent: np.ndarray) -> dict[str, str]:
    """Reasons by figure that these photographs cannot show."""
    reasons = {
        "how prints differ": "there is one print" if len(by_print) < 2 else "",
        "how photographs of a print differ": "each print has one photograph" if len(readings) == len(by_print) else "",
        "the error of reading": "no readable color is on the chart twice"
        if len(np.unique(sent, axis=0)) == len(sent)
        else "",
    }
    return {figure: reason for figure, reason in reasons.items() if reason}


def _read_all(
    prints: Sequence[Sequence[Path]], manifest: Manifest, camera: Camera | None, advance: Advance
) -> tuple[list[PhotoReading], list[str]]:
    """All photographs that can be read, and warnings about the others; refused if none can be read."""
    if not manifest.chart:
        raise Refused("a sheet with a chart", f"sheet {manifest.sheet_id} without", "name the page's own JSON")
    readings, warnings, said, total = [], [], [], sum(map(len, prints))
    for number, paths in enumerate(prints):
        for path in paths:
            try:
                photo = read_photo(path)
                readings.append(PhotoReading(path, number, run_limited(read_chart, photo, manifest, camera)))
                said.append((path.name, photo.said))
            except PhotoRejected as rejection:
                warnings.append(f"{path.name} is left out ({rejection})")
            advance(len(readings) + len(warnings), total)
    if not readings:
        first = warnings[0] if warnings else "none given"
        raise Refused("photographs in which the chart can be read", f"none of {total}", f"see the first: {first}")
    return readings, warnings + summarize_said(said)


def _agreement(readings: Sequence[PhotoReading], by_print: Sequence[np.ndarray]) -> list[float | None]:
    """Mean ΔE00 of each photograph from its print; None for a print's only photograph."""
    numbers = [reading.print_number for reading in readings]
    means = dict(zip(sorted(set(numbers)), by_print, strict=True))
    errors = []
    for reading in readings:
        readable = np.isfinite(reading.chart.light).all(1)
        alone = numbers.count(reading.print_number) == 1 or not readable.any()
        pair = (srgb_from_linear(light[readable]) for light in (reading.chart.light, means[reading.print_number]))
        errors.append(None if alone else float(color_difference(*pair).mean()))
    return errors


def _unreadable(manifest: Manifest, readable: np.ndarray) -> int:
    """Count the swatches of charts in view that no photograph shows well enough; the piece's own do not count."""
    pages = {swatch.page for swatch, is_read in zip(manifest.chart, readable.tolist(), strict=True) if is_read}
    return sum(not readable[row] for page in pages for row in chart_rows(manifest, page))


def _duplicates(sent: np.ndarray, light: np.ndarray) -> float | None:
    """Mean ΔE00 between swatches of the same color at different places: the error of reading."""
    colors, index = np.unique(sent, axis=0, return_inverse=True)
    pairs = [np.flatnonzero(index.reshape(-1) == i)[:2] for i in range(len(colors))]
    pairs = np.array([pair for pair in pairs if len(pair) == 2])
    if not len(pairs):
        return None
    return round(float(color_difference(*(srgb_from_linear(light[pairs[:, i]]) for i in (0, 1))).mean()), 3)


def _row(reading: PhotoReading, error: float | None) -> dict[str, Any]:
    return {
        "file": reading.path.name,
        "sha256": hash_file(reading.path),
        "print": reading.print_number + 1,
        "paper": [round(value, 3) for value in reading.chart.paper],
        "unevenness": round(reading.chart.unevenness, 2),
        "paper_misfit": round(reading.chart.misfit, 4),
        "px_per_mm": round(reading.chart.px_per_mm, 2),
        "delta_e00_from_print": None if error is None else round(error, 2),
    }
