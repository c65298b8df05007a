"""The verbs before anything is optimized: new, preview, plan, keys."""

import shlex
import sys
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Exit, Option

from patchproof.app.cli.console import Overwrite, names_of, say, warn
from patchproof.base.errors import Refused
from patchproof.base.progress import progress_bar
from patchproof.base.text import command_text

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

    network_names = names_of(models)
    lines = new_scene(thing, out, label=label, length_mm=length_mm, up=up, models=network_names, overwrite=overwrite)
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


def plan(
    scene: SceneFile,
    out: Annotated[Path | None, Option(help="Write the plan as JSON, too.")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Show what is modeled, what is not, and why: first how the piece lies, then what is measured."""
    from pydantic_core import to_json

    from patchproof.app.plan.plan import geometry_lines, measured_lines, measured_plan, plan_geometry
    from patchproof.base.output import check_file, write_atomically

    if out is not None:
        check_file(out, overwrite)
    with progress_bar() as bar:
        geometry, problem = plan_geometry(scene, progress=bar)
    warn(geometry["warnings"])
    say(*geometry_lines(geometry))
    sys.stdout.flush()  # what follows takes minutes
    with progress_bar() as bar:
        full_plan = measured_plan(geometry, problem, progress=bar)
    say(*measured_lines(full_plan))
    if out is not None:
        write_atomically(out, to_json(full_plan, indent=1) + b"\n")


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
