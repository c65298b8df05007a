"""The folder of an optimization run, written so that a kill at any moment loses at most 120 views of work.

In: a scene file. Out: RUN/ with `design.png`, `run.json` (settings with the place that was found, versions, seeds,
threads, promise), `steps.jsonl` (one flushed line per step), `views.png` and `checkpoint.safetensors`; after a search
for the place also `place.json` and `place.png`. Nothing depends on the time of day: on one machine, thread count and
device, a seed always gives the same bytes.
"""

import json
import os
import platform
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from pydantic import BaseModel

from patchproof.base import output
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import refuse_other_inputs
from patchproof.base.folder_lock import lock_folder
from patchproof.base.input import is_file, read_file, read_json, read_text
from patchproof.base.output import CHECKPOINT_FILE, RUN_FILE, require_finished_run
from patchproof.base.progress import Advance, Compute, Progress, no_progress
from patchproof.base.settings import SceneSettings, load_scene_settings, named_paths
from patchproof.base.text import short_repr
from patchproof.base.validation import RandomSeed, refuse_untrusted, validate_model
from patchproof.base.version import __version__
from patchproof.classifier.network import Classifier
from patchproof.optimizer import loop
from patchproof.optimizer.expectation import last_pictures
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import PROMISE_VIEWS, VIEWS_PER_SESSION, PromiseOptions, make_promise
from patchproof.optimizer.subject import DESIGN_FILE, DESIGN_FILES, Loss, read_png, side_by_side
from patchproof.scene.interface import Scene
from patchproof.scene.patch_scene import PatchScene, require_unplaced
from patchproof.scene.scene import build_scene
from patchproof.sheets.manifest import MAX_PRINTED_PX, Promise

_LOG_FILE, _VIEWS_FILE = "steps.jsonl", "views.png"
_MAX_LINE_BYTES = 4096  # of the log
_MESH_FILE = "given.glb"  # the mesh of a scene that was made in Python
_STEP_FILES = (CHECKPOINT_FILE, _LOG_FILE, RUN_FILE, _VIEWS_FILE, _MESH_FILE, "place.*")
RUN_FILE_PATTERNS = (*_STEP_FILES, *DESIGN_FILES, "evaluate.json")

# (steps, promised views). A draft's interval is about four times as wide as the default's; a thorough run takes three
# times the steps, and its interval is half as wide (`patchlab charts speed`).
DRAFT_EFFORT, THOROUGH_EFFORT = (40, 40), (720, 1600)
MIN_DESIGN_CHANGE = 1.5 / 255  # a design that moved by less is printed as its start


@dataclass(frozen=True)
class Run:
    """A finished run, read back."""

    folder: Path
    scene: Scene
    design: np.ndarray  # uint8 h×w×3; of a texture run 1×M×3, as in `optimizer.texture.Texture`
    promise: Promise
    details: dict[str, Any]
    SHOWN: ClassVar[tuple[str, ...]] = ("folder", "scene.settings.target.label", "design", "promise")
    __repr__ = short_repr

    def __fspath__(self) -> str:
        return str(self.folder)

    @property
    def history(self) -> list[dict[str, Any]]:
        """One dictionary a step, as steps.jsonl has them: step, loss, confidence, rate, gradient; [] without steps."""
        path = self.folder / _LOG_FILE
        lines = read_text(path, "a log of steps").splitlines() if is_file(path) else ()
        return [json.loads(line) for line in lines]

    def _repr_html_(self) -> str:
        return self.promise.html(self.design if self.scene.HAS_PIECE else None)  # a texture is not one picture


def optimize(
    scene: str | Path | Scene,
    out: str | Path,
    *,
    models: Sequence[str | Classifier] | None = None,
    loss: Loss | None = None,
    seed: int | None = None,
    promise: PromiseOptions = PromiseOptions(),
    compute: Compute = Compute(),
    draft: bool = False,
    thorough: bool = False,
    resume: bool = False,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Run:
    """Optimize the patch of a scene, promise its rate, and write both into a folder.

    Method: Pestana et al., section 3.

    Args:
        scene: a scene, or the path of a scene file.
        out: the run's folder, new or empty.
        models: networks in place of the scene's: names as in scene files, or classifiers in memory.
        loss: `loss(logits N×K, indices) -> N` to descend on, in place of the goal's.
        seed: of all random draws, in place of the scene file's `optimize.seed`; a scene in memory has its own.
        promise: how many views the promise takes, and its controls.
        compute: device and processes; refuses a cluster.
        draft: a first look, in few steps and promised from few views.
        thorough: for a print that counts, three times the steps and four times the views.
        resume: continue from the folder's checkpoint, at the place that was chosen there.
        overwrite: delete an earlier run in the folder first.
        progress: called with the stages "place" (where the scene searches one), "optimize" (steps) and "promise"
            (views).

    Raises:
        Refused: for a scene, network or folder that cannot be used.

    Examples:
        ```python
        run = pp.optimize("scene.toml", "run", compute=pp.Compute(jobs=2))
        print(run.promise.rate, run.promise.interval)
        ```
    """
    out, compute = Path(out), compute.without("optimize", cluster=True)
    with lock_folder(out):
        if resume and any(is_file(out / name) for name in (CHECKPOINT_FILE, _LOG_FILE, "place.json")):
            output.refuse_other_files(out, ("*",))  # links, that is: no other file is written to
        else:
            unfinished = is_file(out / CHECKPOINT_FILE) and not is_file(out / RUN_FILE)
            output.check_folder(out, RUN_FILE_PATTERNS, overwrite, unfinished=unfinished, inputs=(scene,))
        steps, views = effort_of(scene := resolve_scene(scene, seed), draft, thorough, None, promise.views)
        if resume and is_file(out / RUN_FILE):  # `promise` may have made a fuller one of the finished design
            present = validate_model(_Record, read_json(out / RUN_FILE, "a run", "optimize again"), str(out)).promise.n
            views = present if present > (views or PROMISE_VIEWS) else views
        scene, promise = scene.with_steps(steps), replace(promise, views=views)
        save_place, searched = None, {}
        if not scene.HAS_PLACE:
            search_options = {"models": models, "loss": loss, "compute": compute, "progress": progress}
            scene, save_place, searched = _choose_place(scene, out, resume, search_options)
        problem = set_problem(scene, compute.device, models, loss, compute.jobs)
        refuse_other_inputs(searched, problem.inputs, out, scene.settings.model_dump())
        output.refuse_inputs_in(out, named_paths(scene.settings, scene.base).values())
        if not resume:
            output.clear_folder(out)  # everything that the new run needs has been read
        output.make_folder(out)
        if save_place is not None:
            save_place()
        state = loop.load_checkpoint(out, problem) if resume else loop.start(problem)
        design = _run_steps(problem, state, out, partial(progress, "optimize"))
        return finish_run(problem, design, out, promise, progress)


def effort_of(
    scene: Scene, draft: bool, thorough: bool, steps: int | None, views: int | None
) -> tuple[int, int | None]:
    """Return (steps, promised views), given or default: a draft has no more steps than the scene, others no fewer."""
    if draft and thorough:
        raise Refused("a draft or a thorough run", "both", "leave one out")
    limit, effort = (min, DRAFT_EFFORT) if draft else (max, THOROUGH_EFFORT if thorough else (1, None))
    return steps or limit(effort[0], scene.settings.optimize.steps), views or effort[1]


def resolve_scene(scene: str | Path | Scene, seed: int | None, **tables: Mapping[str, Any]) -> Scene:
    """Return a scene in memory, which keeps its seed, or load that of a file with `seed` in place of the file's. Keys
    of `tables` replace the scene's.
    """
    if not isinstance(scene, Scene):
        return build_scene(load_scene_settings(scene, **tables), Path(scene).resolve().parent, seed)
    if seed not in (None, scene.seed):
        raise Refused(f"the seed of the scene in memory, {scene.seed}", f"{seed}", "leave seed out, or name a file")
    if not tables:
        return scene
    built = build_scene(scene.settings.changed(**tables), scene.base, scene.seed, mesh_glb=scene.mesh_glb)
    return replace(built, given_models=scene.given_models)


def _choose_place(
    scene: Scene, out: Path, resume: bool, search_options: Mapping[str, Any]
) -> tuple[PatchScene, Callable[[], None], Mapping[str, str]]:
    """Return the scene with its chosen place, a function that saves the place, and the search's input fingerprints."""
    # only scenes that give no place import the search
    from patchproof.optimizer.place_files import read_place, save_place
    from patchproof.optimizer.place_search import choose_place

    scene = require_unplaced(scene)
    place = (read_place(out, scene) if resume else None) or choose_place(scene, **search_options)
    placed_scene = scene.with_piece_at(place.at, place.spin_deg)
    return placed_scene, lambda: save_place(place, placed_scene, out), place.inputs


def finish_run(
    problem: Problem,
    design: np.ndarray,
    out: Path,
    options: PromiseOptions,
    progress: Progress,
    imported: Mapping[str, Any] | None = None,
) -> Run:
    """Promise a design's rate and write the run's files into a folder; `imported` is an imported design's origin."""
    scene = problem.scene
    problem.subject.save(design, out)
    promise = promise_of(problem, design, options, partial(progress, "promise"))
    if scene.mesh_glb is not None:
        output.write_atomically(out / _MESH_FILE, scene.mesh_glb)
    details = _details(problem, promise, out) | ({} if imported is None else {"imported": dict(imported)})
    return write_run(Run(out, scene, design, promise, details))


def write_run(run: Run) -> Run:
    """Write a run's run.json, and return the run."""
    output.write_json(run.folder / RUN_FILE, run.details)
    return run


def load_run(folder: str | Path, trust: bool = False, named: Iterable[str] = ()) -> Run:
    """Load a finished run; refused if it is missing or unfinished. A run may be somebody else's: without `trust`, paths
    with `${VAR}` are refused, and so are networks that are code or downloads, unless all networks are `named`.
    """
    folder = Path(folder)
    require_finished_run(folder)
    details = read_json(folder / RUN_FILE, "a finished run", "optimize again")
    record = validate_model(_Record, details, str(folder / RUN_FILE))
    settings, promise = record.settings, record.promise
    try:
        base = (folder / record.scene_folder).resolve()
        glb = read_file(folder / _MESH_FILE, "the mesh of a run") if is_file(folder / _MESH_FILE) else None
        if not trust:
            refuse_untrusted(folder / RUN_FILE, (), settings.model_dump(exclude={"target": {"models"}}))
        scene = build_scene(settings, base, record.seed, record.sheet_id, glb)
        files = {key: sha256 for key, sha256 in record.inputs.items() if key in scene.inputs}
        refuse_other_inputs(files, scene.inputs, folder / RUN_FILE, settings.model_dump())
        networks = {key: sha256 for key, sha256 in record.inputs.items() if key.startswith("target.models ")}
        scene = replace(scene, recorded=networks)
        if not trust and not {*settings.target.models} <= {*named}:
            scene = replace(scene, received=folder / RUN_FILE)
        if record.imported is not None:
            scene = replace(scene, known={**scene.known, "design": record.imported.sha256})
        if scene.HAS_PIECE:
            design = read_png(folder / DESIGN_FILE, MAX_PRINTED_PX)
        else:
            from patchproof.optimizer.texture import read_texels

            design = read_texels(scene, folder)
    except Refused:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        raise Refused("a finished run", f"{folder} that cannot be read ({error})", "optimize again") from error
    return Run(folder, scene, design, promise, details)


class _Imported(BaseModel):
    sha256: str


class _Record(BaseModel):
    """The parts of run.json that are read."""

    settings: SceneSettings
    promise: Promise
    scene_folder: str
    seed: RandomSeed
    sheet_id: str
    printer: dict[str, Any]
    inputs: dict[str, str] = {}
    imported: _Imported | None = None


def _run_steps(problem: Problem, state: loop.State, out: Path, advance: Advance) -> np.ndarray:
    """Run the remaining steps, writing log, checkpoint and views; the best design's pixels."""
    settings, largest_gradient, path = problem.scene.settings.optimize, None, out / _LOG_FILE
    # without the lines after the step from which the run resumes
    count = min(state.number, settings.steps) if is_file(path) and path.stat().st_size else 0
    with open(path if count else os.devnull, "rb") as log:
        lines = [log.readline(_MAX_LINE_BYTES) for _ in range(count)]
    output.write_atomically(path, b"".join(lines))
    with open(path, "a", encoding="utf-8") as log:
        for step in loop.steps(problem, state):
            state, names = step.state, ["loss", "confidence", "rate", "gradient"]
            names += [] if step.select_loss is None else ["select_loss", "select_rate"]
            log.write(json.dumps({"step": state.number} | {name: getattr(step, name) for name in names}) + "\n")
            log.flush()
            if loop.ends_interval(settings, state.number, loop.SAVE_AFTER):
                loop.save_checkpoint(state, problem, out)
            largest_gradient = max(step.gradient, largest_gradient or 0.0)
            advance(state.number, settings.steps)
    _warn_if_unchanged(float((state.best - loop.start(problem).design).abs().max()), largest_gradient)
    pictures = last_pictures(problem, state.best)
    labeled = side_by_side(pictures, _answers(problem, pictures))
    output.write_atomically(out / _VIEWS_FILE, output.image_bytes(labeled, "PNG"))
    return problem.subject.pixels(state.best)


def _answers(problem: Problem, pictures: torch.Tensor) -> list[str]:
    """What the first network calls each picture N×3×h×w, as "label 92 %"."""
    network = problem.classifiers[0]
    with torch.inference_mode():
        logits = map(network.logits, pictures.to(problem.stage.device).split(1))
        answers = [network.probabilities(each)[0].max(0) for each in logits]
    return [f"{network.labels[int(best)]} {100 * float(share):.0f} %" for share, best in answers]


def _warn_if_unchanged(change: float, gradient: float | None) -> None:
    """Warn if the design never moved from its start; `change` is its largest change, `gradient` that of all steps."""
    if change > MIN_DESIGN_CHANGE or gradient is None:
        return
    why = "give it more optimize.steps or a larger optimize.step_size"
    if gradient == 0:
        why = "no network's answer depends on it: do the views show it, and is it large enough in them?"
    warnings.warn(f"the design did not change from its start: {why}", stacklevel=3)


def promise_of(problem: Problem, design: np.ndarray, options: PromiseOptions, advance: Advance) -> Promise:
    """The promise of a finished design; a draft if `options.views` are fewer than usual."""
    views = options.views or PROMISE_VIEWS
    half_width = None if options.views else problem.scene.settings.promise.half_width
    conditions = problem.scene.draw("promise", views, per_session=VIEWS_PER_SESSION)
    promise = make_promise(problem, design, conditions, options.controls, advance, VIEWS_PER_SESSION, half_width)
    return promise.changed(draft=views < PROMISE_VIEWS)


def _details(problem: Problem, promise: Promise, out: Path) -> dict[str, Any]:
    scene = problem.scene
    packages = ("torch", "numpy", "kornia", "trimesh")  # those that results depend on
    return {
        "sheet_id": scene.sheet_id,
        "seed": scene.seed,
        "device": str(problem.device),
        "threads": torch.get_num_threads(),
        "python": platform.python_version(),
        "versions": {"patchproof": __version__} | {name: version(name) for name in packages},
        "scene_folder": os.path.relpath(scene.base.resolve(), out.resolve()),
        "settings": scene.settings.model_dump(mode="json"),
        "printer": problem.printer.provenance | {"method": problem.printer.method},
        "inputs": problem.inputs,
        "placement": scene.record(),
        "warnings": [*scene.warnings, *(note for network in problem.classifiers for note in network.notes)],
        "select_after_views": loop.SELECT_AFTER,
        "promise": promise.model_dump(mode="json"),
    }
