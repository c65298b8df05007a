"""A user's script, which is not run: `basedpyright` finds no error in what is right, and one in each marked mistake."""

# pyright: reportUnnecessaryTypeIgnoreComment=error

import numpy as np
import torch

import patchproof as pp


def progress(stage: str, done: int, total: int) -> None:
    print(pp.__version__, stage, done, total)


report_progress: pp.Progress = progress
compute, promise = pp.Compute(jobs=2), pp.PromiseOptions(views=40, controls=("bare",))
scene: pp.Scene = pp.load_scene("scene.toml")
made = pp.make_scene(pp.SceneSettings.model_validate({}), base=".")
conditions: pp.Conditions = scene.draw("evaluate", 4)
stage: pp.Stage = pp.set_stage(scene)
pictures: torch.Tensor = pp.photograph(stage, None, conditions, (96, 96))
classifier: pp.Classifier = pp.classifier_of(lambda photos: photos.mean((2, 3)), 32, ["a", "b", "c"])
detector: pp.Detector = pp.detector_of(torch.nn.Identity(), 32, ["a"])
printer: pp.Printer = pp.load_printer("coated")
place: pp.Place = pp.choose_place(made, models=[pp.load_classifier("file:net.onnx")], progress=report_progress)
try:
    run: pp.Run = pp.optimize(scene, "run", promise=promise, compute=compute, progress=report_progress)
except pp.Refused as error:
    raise SystemExit(str(error)) from error
except pp.PatchproofError:
    raise
run = pp.import_patch(np.zeros((64, 64, 3), np.uint8), scene, "imported", models=[classifier, detector])
said: pp.Promise = pp.load_run("run").promise
rate: float = said.rate
manifest: pp.Manifest = pp.sheet(run, "sheet.pdf")
manifest = pp.load_manifest("sheet.json")
taken: pp.Reprint = pp.reprint("sheet.pdf", run, 6, "photos", pp.ReprintSetup(printer="uncoated"), compute=compute)
px_from_mm: np.ndarray | None = next(iter(taken.photos.values())).homography_px_from_mm
evaluation: pp.Evaluation = pp.evaluate("run", n=8)
share: float = evaluation.models["builtin"].controls["bare"].rate
compared = pp.compare(["run", "imported"], "compared")
shown: pp.Preview = pp.preview(made, "preview", overwrite=True)
with pp.progress_bar() as bar:
    run = pp.promise_run(run.folder, views=400, progress=bar)
steps: list = run.history
report: pp.Report = pp.verify("photos", "sheet.json", "report", capture=pp.CaptureInfo(ruler_mm=(97.1, 97.3)))
verdict: str = report.summary.verdict
goal: pp.Goal = scene.settings.target.goal
rejected: type[pp.PhotoRejected] = pp.PhotoRejected

# three mistakes
scene = pp.load_scene(7)  # pyright: ignore[reportArgumentType]
pictures = pp.photograph(pp.set_stage(scene), None, conditions, 96)  # pyright: ignore[reportArgumentType]
wrong_rate: str = pp.optimize(scene, "run").promise.rate  # pyright: ignore[reportAssignmentType]
