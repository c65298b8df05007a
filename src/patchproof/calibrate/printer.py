"""`calibrate printer`: make NAME.npz and NAME.json from a profile or photographs, and summarize them.

Nothing is written before the printer is complete, and existing files are replaced only on request.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from patchproof.base.errors import Refused
from patchproof.base.output import check_file, write_files_atomically
from patchproof.base.progress import Progress, no_progress
from patchproof.calibrate.chart import PRIORS, calibrate_chart, prints_of, summary_lines
from patchproof.calibrate.icc import bake
from patchproof.channel.printer import Printer, printer_contents
from patchproof.sheets.manifest import load_manifest

if TYPE_CHECKING:
    from patchproof.evidence.task import Options


def printer_from_icc(profile: Path, out: Path, perceptual: bool, overwrite: bool = False) -> list[str]:
    """Write the printer of an ICC output profile; returns the summary."""
    out = _new_file(out, overwrite)
    printer = bake(profile, out.stem, perceptual)
    error = printer.provenance["delta_e00_to_exact_chain"]
    return [
        f"{printer.provenance['profile']} ({printer.provenance['profile_colors']}), {printer.provenance['intents']}",
        f"table against LittleCMS on {error['colors']:,} random colors: "
        f"ΔE00 mean {error['mean']}, p95 {error['p95']}, max {error['max']}",
        _write_files(printer, out),
    ]


def printer_from_chart(
    photos: Sequence[Path], sheet: Path, out: Path, overwrite: bool = False, progress: Progress = no_progress
) -> tuple[list[str], tuple[str, ...]]:
    """Write the printer measured from photographs of a chart; returns the summary and warnings."""
    out = _new_file(out, overwrite)
    result = calibrate_chart(prints_of(photos), load_manifest(sheet), out.stem, partial(progress, "chart"))
    return [*summary_lines(result), _write_files(result.printer, out)], result.warnings


def printer_from_design(
    photos: Sequence[Path],
    sheet: Path,
    out: Path,
    options: "Options",
    known: str | None,
    overwrite: bool,
    bar: Progress,
) -> tuple[list[str], tuple[str, ...]]:
    """Write the printer measured from photographs of a known design; returns the summary and warnings."""
    from patchproof.calibrate.known_design import calibrate_design

    out, names = _new_file(out, overwrite), (known,) if known else ("office", *PRIORS)
    groups, advance = prints_of(photos), partial(bar, "photographs")
    printer, warnings = calibrate_design(groups, load_manifest(sheet), out.stem, options, names, advance)
    lines = [f"{key}: {value}" for key, value in printer.provenance.items() if isinstance(value, str)]
    return [*lines, _write_files(printer, out)], warnings


def _new_file(out: Path, overwrite: bool) -> Path:
    """`out` as NAME.npz; refused where either file exists, or the suffix is of another kind of file."""
    if out.suffix.lower() not in {"", ".npz", ".json"}:
        raise Refused("a printer file, NAME.npz", f"{out.name}", "choose another --out")
    out = out.with_suffix(".npz")
    for path in (out, out.with_suffix(".json")):
        check_file(path, overwrite)
    return out


def _write_files(printer: Printer, out: Path) -> str:
    write_files_atomically(printer_contents(printer, out))
    return f"written: {out}, {out.with_suffix('.json').name}"
