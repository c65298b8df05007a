"""Calibrate a printer from photographs of its printed chart.

In: photographs of one or several prints of a page with a chart, and its manifest. Out: a `Printer` whose provenance
holds every rung of the ladder, every photograph and how much they disagree. Light relative to paper is averaged over
the photographs of a print (their median from three on), then over prints.

The table is an *appearance* model: what this camera showed of this printer, decoded as sRGB. Tone curves of camera and
printer are one product in a photograph, and nothing on the page separates them. It describes the paper under the light
it was photographed in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.color import linear_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import hash_file, is_file, is_folder
from patchproof.base.progress import Advance, no_advance
from patchproof.calibrate import color_ladder
from patchproof.calibrate.chart_photo import ChartPhoto, read_chart
from patchproof.calibrate.color_ladder import ColorMap, MapChoice, choose_map, color_difference, map_kinds
from patchproof.channel.printer import Printer, load_printer, node_colors, printer_from_table, printer_output
from patchproof.photo.limits import run_limited
from patchproof.photo.read import list_images, read_photo, summarize_said
from patchproof.photo.rejection import PhotoRejected
from patchproof.sheets.manifest import Manifest

PRIORS = ("coated", "uncoated")
MIN_SWATCHES = 4  # paper, black and two others
MAX_PHOTO_DELTA_E00 = 5.0  # from its print's other photographs: more than light or camera can explain


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
    if choice.width < color_ladder.WELL_SPREAD_WIDTH:
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
            raise Refused("a folder with photographs of one print", f"none in {folder}", "name the photographs")
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
    white = np.maximum(light[-1], 0.1)
    lut = srgb_from_linear(np.clip(light / white, 0, 1)).reshape(nodes.shape)
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
    lines.append(differ if provenance["delta_e00_of_prints"] else "how prints differ is not measured: there is one")
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
