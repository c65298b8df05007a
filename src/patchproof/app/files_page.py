"""Write what files may declare, and what is done with each declaration, as one Markdown page.

In: the readers' own lists. Out: a table for each kind of input. What is not in a list is not read: such as sidecar
files, or the comments in a file.
"""

from importlib import import_module

from patchproof.base.declared import Declaration

HEAD = """# What files declare

Printed by `patchproof keys --files` from the lists of the readers. *used*: taken as the file says. *refused*: one
sentence, exit code 1 (a photograph: rejected with its code). *said*: left aside, with a line in the command's output,
the preview and the report.
"""
# the kinds of input, and the modules whose DECLARED lists what they can declare
READERS: dict[str, tuple[str, ...]] = {
    "Meshes": ("mesh.declarations",),
    "Networks": ("classifier.declarations",),
    "Photographs and pictures": ("photo.declarations",),
    "PDFs": ("sheets.declarations",),
    "Settings and text files": ("base.declarations",),
    "Boxes": ("evidence.declarations",),
}


def declarations(reader: str) -> tuple[Declaration, ...]:
    """The lists of one kind of input in `READERS`, joined."""
    return tuple(entry for module in READERS[reader] for entry in import_module(f"patchproof.{module}").DECLARED)


def files_page() -> str:
    """Write the page of all kinds of input as Markdown."""
    lines = [HEAD]
    for reader in READERS:
        lines += [f"## {reader}", "", "| file | declares | answer | how |", "|---|---|---|---|"]
        lines += [f"| {' | '.join(entry)} |" for entry in declarations(reader)] + [""]
    return "\n".join(lines)
