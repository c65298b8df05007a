"""Write the designs of several runs on one page, with a manifest for each."""

from collections.abc import Sequence
from pathlib import Path

from patchproof.optimizer.run import Run
from patchproof.reprints.run_sheet import content_of, plan_of
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.template import load_template
from patchproof.sheets.write import write_several


def sheet_of_several(
    runs: Sequence[Run], pdf_path: str | Path, *, template: str | None = None, control: str | None = None
) -> list[Manifest]:
    """Write one page with the designs of several runs, and a manifest for each; on the first run's template unless
    another is named.
    """
    name = template or runs[0].scene.settings.sheet.template
    page, contents = load_template(name), [content_of(run, name, control, Path(pdf_path).parent) for run in runs]
    plans = [plan_of(scene, page, content) for content, scene in contents] if page.plan_page else []
    return write_several(pdf_path, page, [content for content, _ in contents], plans)
