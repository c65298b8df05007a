"""The verbs of `calibrate`: printer, camera."""

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, BadParameter, Option

from patchproof.app.cli.console import Overwrite, pair_of, say, warn
from patchproof.base.progress import progress_bar
from patchproof.base.text import command_text

_NEXT = f"next: {command_text('optimize', 'scene.toml', '--out', 'run')}, with"


def printer(
    out: Annotated[Path, Option(help="NAME.npz; NAME.json is written beside it.")],
    photos: Annotated[list[Path] | None, Argument(metavar="[PHOTO]...", help="A folder: of one print, place.")] = None,
    icc: Annotated[Path | None, Option(help="An RGB or CMYK output profile.")] = None,
    intent: Annotated[
        Literal["relative", "perceptual"], Option(help="The profile's intent that the driver is set to.")
    ] = "relative",
    design: Annotated[
        bool, Option("--design", help="They show a print of known pixels, that of --sheet; else a printed chart.")
    ] = False,
    corners: Annotated[Path | None, Option(help="CSV or COCO JSON with the design's four corners.")] = None,
    find: Annotated[bool, Option("--find", help="Search for the design where no marker can be read.")] = False,
    known: Annotated[
        Literal["office", "coated", "uncoated"] | None, Option(help="For colors that the design lacks; else the best.")
    ] = None,
    sheet: Annotated[Path | None, Option(help="The manifest of the chart's page, or of the design.")] = None,
    camera: Annotated[str | None, Option(help="The camera that took photographs of a design.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """A printer from its ICC profile, or from photographs of its printed chart or of any design."""
    from patchproof.base.errors import Refused
    from patchproof.base.output import check_file, write_files_atomically
    from patchproof.channel.printer import load_printer, printer_contents

    photos, lines, warnings = photos or [], [], ()
    if (icc is None) != bool(photos):
        raise BadParameter("give either --icc FILE or PHOTO...", param_hint="--icc / PHOTO...")
    if not design and (corners or find or known or camera):
        only = "--corners, --find, --camera and --known are for PHOTO... --design"
        raise BadParameter(only, param_hint="--design")
    if out.suffix.lower() not in {"", ".npz", ".json"}:
        raise Refused("a printer file, NAME.npz", f"{out.name}", "choose another --out")
    file = out.with_suffix(".npz")
    for path in (file, out.with_suffix(".json")):
        check_file(path, overwrite)
    if icc is not None:
        from patchproof.calibrate.icc import bake

        made = bake(icc, file.stem, intent == "perceptual")
    elif sheet is None:
        raise BadParameter("name the JSON that was written beside the PDF", param_hint="--sheet")
    else:
        from patchproof.calibrate.chart import calibrate_chart, prints_of, summary_lines
        from patchproof.sheets.manifest import load_manifest

        groups, manifest = prints_of(photos), load_manifest(sheet)
        with progress_bar() as bar:
            if design:
                from patchproof.calibrate.known_design import KNOWN_PRINTERS, calibrate_design
                from patchproof.channel.lens import load_camera
                from patchproof.evidence.annotations import load_corners
                from patchproof.evidence.task import Options

                named, names = load_corners(corners) if corners else {}, (known,) if known else KNOWN_PRINTERS
                camera_file, advance = load_camera(camera) if camera else None, partial(bar, "photographs")
                options = Options((), load_printer(names[0]), camera_file, corners=named, find=find)
                made, warnings = calibrate_design(groups, manifest, file.stem, options, names, advance)
            else:
                result = calibrate_chart(groups, manifest, file.stem, partial(bar, "chart"))
                made, warnings, lines = result.printer, result.warnings, summary_lines(result)
    write_files_atomically(printer_contents(made, file))
    warn(warnings)
    lines = lines or [f"{key}: {value}" for key, value in made.provenance.items() if not isinstance(value, list)]
    say(*lines, f"written: {file}, {file.stem}.json", f'{_NEXT} profile = "{file}" in its [printer]')


def camera(
    photos: Annotated[Path, Argument(help="A folder of photographs of a board.")],
    board: Annotated[str, Option(help="The board's template, or the BOARD.json beside its PDF.")] = "charuco_a4",
    out: Annotated[Path, Option(help="The camera file.")] = Path("camera.json"),
    ruler_mm: Annotated[str | None, Option(help="The printed rulers as measured, e.g. 97.1x97.3 (x, y).")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Focal length, middle and lens distortion of a camera."""
    from patchproof.calibrate.camera import calibrate_camera, calibration_lines

    ruler = None if ruler_mm is None else pair_of(ruler_mm, "--ruler-mm")
    with progress_bar() as bar:
        fitted_camera = calibrate_camera(photos, board, out, ruler_mm=ruler, overwrite=overwrite, progress=bar)
    say(*calibration_lines(fitted_camera), f"camera: {out}", f'{_NEXT} file = "{out}" in its [camera]')
