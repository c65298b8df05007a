"""Sheets that are mounted and photographed in simulation; their PDF is temporary."""

from pathlib import Path
from tempfile import TemporaryDirectory

from patchproof.channel.printer import load_printer
from patchproof.render.stage import Stage
from patchproof.reprints.reprint import MountedSheet, sent_pixels
from patchproof.sheets.content import SheetContent
from patchproof.sheets.template import load_template
from patchproof.sheets.write import write_sheet


def mount_content(stage: Stage, content: SheetContent) -> MountedSheet:
    """Mount a sheet of the stage's scene with this content in its piece."""
    template = load_template(stage.scene.settings.sheet.template)
    with TemporaryDirectory() as folder:
        pdf = Path(folder) / "sheet.pdf"
        manifest = write_sheet(pdf, template, content)
        sent = sent_pixels(pdf, manifest, stage.scene)
    return MountedSheet(stage, manifest, sent, load_printer(stage.scene.settings.printer.profile, stage.scene.base))
