"""Copy the example programs and their scenes."""

from pathlib import Path

from patchproof.base.errors import Refused
from patchproof.base.output import make_folder, write_atomically


def copy_examples(folder: Path) -> list[str]:
    """Copy them into a new or empty folder, any other is refused; returns a line about each program."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        got = f"{folder}, which {'has files' if folder.is_dir() else 'is a file'}"
        raise Refused("a new or empty folder", got, "name another")
    make_folder(folder)
    lines = []
    for path in sorted((Path(__file__).parents[1] / "examples").glob("*.*")):
        write_atomically(folder / path.name, path.read_bytes())
        if path.suffix == ".py":
            lines.append(f"{path.name}: {path.read_text(encoding='utf-8').splitlines()[0].strip(chr(34))}")
    return lines
