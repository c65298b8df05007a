"""The verbs before anything is optimized: new, preview, plan, examples, keys; and `calibrate printer`, `camera`."""

import shlex
import sys
from functools import partial
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, BadParameter, Exit, Option

from patchproof.app.cli.console import Overwrite, names_of, pair_of, say, warn
from patchproof.base.errors import Refused
from patchproof.base.progress import progress_bar
from patchproof.base.text import command_text

_NEXT = f"next: {command_text('optimize', 'scene.toml', '--out', 'run')}, with"
SceneFile = Annotated[Path, Argument(help="The scene file (TOML).")]


def new(
    thing: Annotated[
        str, Argument(metavar="MESH|PHOTOS|IMAGES", help="A mesh file, primitive:NAME, or a folder of pictures.")
    ],
    out: Annotated[Path, Option(help="The scene file to write.")] = Path("scene.toml"),
    label: Annotated[str | None, Option(help="Words of the target's label; else of the file's name.")] = None,
    length_mm: Annotated[float | None, Option(min=1e-3, help="The longest extent; else by the file's units.")] = None,
    up: Annotated[Literal["y", "z"] | None, Option(help="The file's axis that points up.")] = None,
    models: Annotated[str | None, Option(help="Comma-separated classifiers; else imagenet or builtin.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a commented scene for an object, photographs of it, or a folder of images."""
    from patchproof.app.begin.new import new_scene

    lines = new_scene(thing, out, label=label, length_mm=length_mm, up=up, models=names_of(models), overwrite=overwrite)
    say(*lines, f"scene: {out}", f"next: {command_text('preview', out)}")


def preview(
    scene: SceneFile,
    out: Annotated[Path, Option(help="Folder for the page and the object.")] = Path("patchproof-preview"),
    overwrite: Overwrite = False,
) -> None:
    """A page that shows the object, the piece on it, and what networks see now; in seconds."""
    from patchproof.app.begin.preview import preview as preview_scene

    result = preview_scene(scene, out, overwrite=overwrite)
    warn(result.warnings)
    say(*result.lines, f"page: {result.page}")
    if result.refused:
        print(result.refused, file=sys.stderr)
        raise Exit(1)
    say(f"next: {command_text('optimize', scene, '--out', 'run')} (--draft for a first look)")


def plan(scene: SceneFile) -> None:
    """Show what is modeled, what is not, and why: first how the piece lies, then what is measured."""
    from patchproof.app.plan.plan import measured_lines, plan_geometry

    with progress_bar() as bar:
        problem, lines = plan_geometry(scene, progress=bar)
    warn(problem.scene.warnings)
    say(*lines)
    sys.stdout.flush()  # what follows takes minutes
    with progress_bar() as bar:
        lines = measured_lines(problem, progress=bar)
    say(*lines)


def examples(folder: Annotated[Path, Argument(help="The folder to copy them to, new or empty.")]) -> None:
    """Copy five programs and their scenes: a patch on a box, your network, photographs, a detector, a print."""
    from patchproof.base.output import make_folder, write_atomically

    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        got = f"{folder}, which {'has files' if folder.is_dir() else 'is a file'}"
        raise Refused("a new or empty folder", got, "name another")
    make_folder(folder)
    for path in sorted((Path(__file__).parents[1] / "examples").glob("*.*")):
        write_atomically(folder / path.name, path.read_bytes())
        if path.suffix == ".py":
            say(f"{path.name}: {path.read_text(encoding='utf-8').splitlines()[0].strip(chr(34))}")
    say(f"next: cd {shlex.quote(str(folder))} && python box.py")


def keys(
    name: Annotated[str | None, Argument(help="scene, template or board; without one, all.")] = None,
    files: Annotated[bool, Option("--files", help="What files may declare, and what is done with it.")] = False,
    codes: Annotated[bool, Option("--codes", help="What photographs' codes say, and what helps.")] = False,
) -> None:
    """All keys of scene files and page templates: range, unit, default and meaning, as Markdown."""
    from patchproof.app.keys import DOCUMENTS, codes_table, files_page, keys_page

    print(codes_table() if codes else files_page() if files else keys_page(DOCUMENTS, name), end="")


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
    from patchproof.base.output import check_file, write_files_atomically
    from patchproof.channel.printer import load_printer, printer_contents

    photos, lines, warnings = photos or [], [], ()
    if (icc is None) != bool(photos):
        raise BadParameter("give either --icc FILE or PHOTO...", param_hint="--icc / PHOTO...")
    if not design and (corners or find or known or camera):
        raise BadParameter("--corners, --find, --camera and --known are for PHOTO... --design", param_hint="--design")
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
