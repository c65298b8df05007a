"""The demo: from scene to report on an object and a network of the package, or a network of photographs, offline.

In: which network. Out: scene.toml run/ sheet.pdf sheet.json photos/ report/. Its conditions are hard on purpose: far,
dim, oblique and in cluttered places, so that the bare object and the controls are often misread and a patch can help.
"""

from pathlib import Path

from patchproof.app.verify import verify
from patchproof.base.output import new_folder
from patchproof.base.progress import Compute, Progress, no_progress
from patchproof.optimizer.run import optimize
from patchproof.report.words import promise_lines, verdict_lines
from patchproof.reprints.reprint import reprint
from patchproof.reprints.run_sheet import sheet

PHOTOS, SESSIONS = 48, 12
DEMO_FILES = ("scene.toml", "run", "sheet.pdf", "sheet.json", "photos", "report")

SCENE = Path(__file__).with_name("demo.toml").read_text(encoding="utf-8")


def run_demo(
    out: Path, imagenet: bool = False, *, jobs: int = 1, overwrite: bool = False, progress: Progress = no_progress
) -> list[str]:
    """Run every step into the folder `out`, before the built-in network or `imagenet`; returns the summary's lines."""
    compute = Compute(jobs=jobs)
    with new_folder(out, DEMO_FILES, overwrite) as folder:
        pdf, photos, report = folder / "sheet.pdf", folder / "photos", folder / "report"
        run = optimize(demo_scene(folder, imagenet), folder / "run", compute=compute, progress=progress)
        sheet(run, pdf)
        reprint(pdf, run, PHOTOS, photos, sessions=SESSIONS, compute=compute, progress=progress)
        judgment = verify(photos, folder / "sheet.json", report, compute=compute, progress=progress)
    return [
        "Hard conditions on purpose (far, dim, oblique, cluttered): bare object and controls are often misread.",
        *promise_lines(run.promise, run.scene.settings.model_dump(), str(run.folder)),
        *verdict_lines(judgment),
        *(f"{out}/{name}" for name in ("run/design.png", "sheet.pdf", "sheet.json", "photos/")),
        f"open this in a browser: {out}/report/report.html",
    ]


def demo_scene(folder: Path, imagenet: bool = False) -> Path:
    """Write scene.toml into a folder and return its path."""
    scene = folder / "scene.toml"
    scene.write_text(Path(__file__).with_name("demo_imagenet.toml").read_text("utf-8") if imagenet else SCENE, "utf-8")
    return scene
