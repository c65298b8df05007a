"""Simulate photographs of a printed sheet on its object (of pages that belong to no run: see `page_photos`).

In: a sheet's PDF and the run it was made from. Out: a folder of JPEG photographs of that piece on the object,
`truth.json` with each one's homography and conditions, `coco.json` with boxes of object and piece, and for a print
without markers `corners.csv`, which `verify --corners` takes.
Conditions come from the reprint stream, which nothing else uses: one print, photographed in one or several sessions,
each with its own place, light, camera and folder.
"""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

from patchproof.base.compute import Compute
from patchproof.base.errors import Refused
from patchproof.base.output import make_folder, new_folder
from patchproof.base.progress import Progress, no_progress
from patchproof.base.text import short_repr
from patchproof.base.workers import fork_workers, result_of
from patchproof.optimizer.run import Run
from patchproof.report.coco import PATCH, LabeledPhoto, coco_json
from patchproof.reprints.mounted_sheet import (
    DEFAULT_SETUP,
    SIDE_POINTS,
    PhotoTruth,
    ReprintSetup,
    mount_sheet,
    sheet_scene,
)
from patchproof.reprints.run_sheet import sheet as sheet_of

REPRINT_FILES = ("photo_*.jpg", "session_*", "truth.json", "coco.json", "corners.csv")


@dataclass(frozen=True)
class Reprint:
    """Simulated photographs in a folder, with the truth about each by file name."""

    folder: Path
    photos: dict[str, PhotoTruth]
    __repr__ = short_repr


def reprint(
    pdf_path: str | Path,
    run: Run,
    n: int,
    out: str | Path,
    how: ReprintSetup = DEFAULT_SETUP,
    *,
    sessions: int = 1,
    seed: int | None = None,
    compute: Compute = Compute(),
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Reprint:
    """Print a sheet in simulation, mount the piece on its object, and photograph it.

    Args:
        pdf_path: the sheet's PDF, its manifest beside it.
        run: the run that the sheet was made from.
        n: photographs in all, 1 or more.
        out: folder for the JPEG files, `truth.json` and `coco.json`; one folder a session inside, if there are several.
        how: printer, print scale, a control in place of the design, and the renderer.
        sessions: places to photograph in, 1 to n, each with a light and camera of its own.
        seed: of the conditions, in place of the scene's.
        compute: processes; the renderer runs on the CPU: another device is refused, and so is a cluster.
        overwrite: delete earlier photographs in `out` first.
        progress: called with the stage "photograph".

    Raises:
        Refused: where the PDF is not of this run.
    """
    compute = compute.without("reprint", device=True, cluster=True)
    if not 1 <= sessions <= n:
        raise Refused(f"1 to {n} sessions of {n} photographs", f"{sessions}", "ask for fewer")
    with _pdf_to_mount(pdf_path, run, how.control, Path(out)) as pdf:
        sheet = mount_sheet(pdf, run, how)
        each, done = -(-n // sessions), 0
        conditions = sheet.scene.draw("reprint", n, seed, per_session=each)
        scale = conditions.pose.printed_scale[[0] * n]  # one print, wherever it is photographed
        pose = replace(conditions.pose, printed_scale=scale)
        conditions = replace(conditions, print=conditions.print[[0] * n], pose=pose)
        views = [conditions[i : i + 1] for i in range(n)]
        names = [f"photo_{i + 1:04d}.jpg" for i in range(n)]
        if sessions > 1:
            names = [f"session_{i // each + 1:02d}/{name}" for i, name in enumerate(names)]
        opening = fork_workers(sheet.photograph, compute.jobs)
        with new_folder(out, REPRINT_FILES, overwrite, (pdf_path, run.folder)) as folder, opening as (workers, take):
            for i, photo in workers.completed(take, views):
                make_folder((folder / names[i]).parent)
                (folder / names[i]).write_bytes(result_of(photo))
                done += 1
                progress("photograph", done, n)
            label, size_px = str(sheet.scene.settings.target.label), sheet.scene.photo_px
            photos = [LabeledPhoto(name, size_px, sheet.outlines(v)) for name, v in zip(names, views, strict=True)]
            text = coco_json(photos, label, f"simulated photographs of sheet {sheet.manifest.sheet_id}")
            (folder / "coco.json").write_text(text, encoding="utf-8")
            truth = dict(zip(names, map(sheet.truth, views), strict=True))
            entries = {name: photo.to_json() for name, photo in truth.items()}
            (folder / "truth.json").write_text(json.dumps(entries, indent=1) + "\n", encoding="utf-8")
            if not sheet.manifest.markers:
                from patchproof.evidence.annotations import CORNERS_FILE, corners_csv

                shown = {photo.file: photo.outlines[PATCH] for photo in photos if PATCH in photo.outlines}
                text = corners_csv({name: outline[::SIDE_POINTS] for name, outline in shown.items()})
                (folder / CORNERS_FILE).write_text(text, encoding="utf-8")
    return Reprint(Path(out), truth)


@contextmanager
def _pdf_to_mount(pdf_path: str | Path, run: Run, control: str | None, out: Path) -> Iterator[str | Path]:
    """Yield the PDF to mount: the given one, or a control's in a temporary folder."""
    if control in (None, "bare"):
        yield pdf_path
        return
    with TemporaryDirectory() as folder:
        template = sheet_scene(pdf_path, run)[1].settings.sheet.template
        path = Path(folder) / f"control{Path(pdf_path).suffix}"
        sheet_of(run, path, template=template, control=control)
        yield path
