"""Patches optimized in 3D against patches optimized in 2D, both hung on the object and seen in the same views.

In: scene files with meshes, networks, seeds. A cell is one of each: the scene's patch is optimized in 3D, as `optimize`
does, and once more as the classic 2D patch: pasted flat at a random place, size and angle into renders of the same
clean object over the same backgrounds (renders, since photographs of most objects do not exist), with Random Erasing.
Same design grid, same frame, printer and camera; sizes in pixels from the 3D views; the same number of classifier
passes. Then both hang on the object, under conditions of the evaluate stream, beside the bare object, gray and noise.
Out: paired differences per condition, pooled, by mesh, and by network and view (where the camera stands).

Left out on purpose: the 2D patch knows neither light nor place, since images say nothing of them. Whether it is weak in
its own world, too, is measured: both designs are shown in held-out images as well.
Sources: Pestana et al., algorithm "Masked Textures and 3D Patches" and the table of 2D and 3D patches by model and
view, supplement algorithm 2 (2D patch); Brown et al., Adversarial Patch, 2017.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from patchproof.claims import Estimate, difference, rate
from patchproof.experiments.image_classes import write_labels, write_renders
from patchproof.geometry import local_scale
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.photograph import Shown, expose
from patchproof.render.stage import set_stage
from patchproof.report.tables import Drawing, Table
from patchproof.scene.image_scene import largest_share, load_image_scene
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.scene import build_scene
from patchproof.settings import ObjectSettings, PatchSettings, SceneSettings, ViewSettings, load_scene_settings
from patchproof.sheets.piece import sheet_id
from patchproof.strict import Range, Refused, Share, Strict, expand
from patchproof.study.study import Cell, Result, Study
from patchproof.study.trials import clustered, enlarged, grouped, logits_of, passes, png_of, short

KINDS = ("bare", "grey", "noise", "2d", "3d")
HARD = 0.2  # clean rate up to which an object counts as misread
_TILE_PX = 192
_SIZES = (0.05, 0.95)  # quantiles of the design's size over the 3D views that bound its size in 2D


class Patch3dSettings(Strict):
    """Scenes × models × seeds; how patches are trained stands in each scene's [optimize]."""

    scenes: Annotated[tuple[str, ...], Field(min_length=1)]  # scene files
    models: tuple[str, ...] = ()  # in place of the scenes' own
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0, 1, 2)  # of the optimizer
    conditions: Annotated[int, Field(ge=1)] = 200  # of the evaluate stream, per cell
    renders: Annotated[int, Field(ge=2)] = 64  # images of the clean object; from 20 on, half of them are held out
    roll_deg: Range = (-22.5, 22.5)  # of the 2D patch, as in Brown et al.'s published program
    erasing: Share = 0.5  # chance of Random Erasing in 2D training
    # Azimuths in degrees by name; without any, thirds of each scene's own range.
    views: dict[str, Range] = Field(default_factory=dict)


def cells(settings: Patch3dSettings, base: Path) -> list[Cell]:
    """Scenes × models × seeds."""
    found = []
    for name in settings.scenes:
        scene = load_scene_settings(expand(name, base))
        if scene.object.mesh is None or scene.patch.kind != "patch":
            raise Refused("a scene with a mesh and a printed patch", name, 'give object.mesh and patch.kind = "patch"')
        identity = sheet_id(scene.model_dump(mode="json"), 0)
        for model, seed in itertools.product(settings.models or scene.target.models, settings.seeds):
            values = {"scene": name, "model": model, "seed": seed, "settings": identity}
            found.append(Cell(f"{Path(name).stem}-{short(model)}-{seed}", values))
    # all objects with the first seed come first: an unfinished study says something of each
    return sorted(found, key=lambda cell: settings.seeds.index(cell.values["seed"]))


def run(settings: Patch3dSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """One object, network and seed: optimize in both worlds, measure in both."""
    path, seed = Path(expand(cell.values["scene"], base)), cell.values["seed"]
    scene = build_scene(load_scene_settings(path), path.resolve().parent, seed)
    model = cell.values["model"]
    problem = set_problem(scene, models=(expand(model, base) if settings.models else model,))
    with tempfile.TemporaryDirectory() as folder:
        twin = flat_twin(problem, settings, Path(folder))
    designs = {"3d": best_design(problem), "2d": best_design(twin)}
    conditions = scene.draw("evaluate", settings.conditions)
    flat_conditions = twin.scene.draw("evaluate", settings.conditions)
    seen = _found(problem, logits_of(problem, shown_with_controls(problem, designs), conditions))
    flat = _found(twin, logits_of(twin, shown_with_controls(twin, designs), flat_conditions))
    return {
        "recognized": seen["recognized"],
        "confidence": seen["confidence"],
        "recognized_in_images": flat["recognized"],
        "azimuth_deg": conditions.pose.azimuth_deg.tolist(),
        "azimuth_range_deg": scene.settings.view.azimuth_deg,
        "passes": {name: passes(one) for name, one in (("3d", problem), ("2d", twin))},
        "share": twin.scene.settings.view.patch_share,
        "warnings": list(scene.warnings),
        f"{cell.name}.png": png_of(picture_of(problem, twin, designs)),
        f"{cell.name}-2d.png": png_of(designs["2d"]),
        f"{cell.name}-3d.png": png_of(designs["3d"]),
    }


def flat_twin(problem: Problem, settings: Patch3dSettings, folder: Path) -> Problem:
    """The same patch as a classic 2D one: its scene is made of renders that are written to `folder`."""
    scene = problem.scene
    write_labels(
        [
            (name, scene.settings.target.label)
            for name in write_renders(problem.stage, settings.renders, problem.training_px, folder)
        ],
        folder,
    )
    flat = load_image_scene(flat_settings(scene, settings), folder, scene.seed)
    subject = Patch(flat, problem.printer, problem.subject.design_px, problem.device)
    return replace(problem, scene=flat, stage=set_stage(flat, problem.device), subject=subject)


def flat_settings(scene: MeshScene, settings: Patch3dSettings) -> SceneSettings:
    """A scene of images with the patch, printer, camera and optimizer of a scene with a mesh, and as large in it."""
    patch = PatchSettings(width_mm=scene.settings.patch.width_mm, height_mm=scene.settings.patch.height_mm)
    low, high = np.quantile(design_shares(scene), _SIZES)
    largest = largest_share((patch.width_mm, patch.height_mm), settings.roll_deg)
    share = (float(min(low, largest)), float(min(high, largest)))
    return scene.settings.model_copy(
        update={
            "object": ObjectSettings(images=".", labels="labels.csv"),
            "patch": patch,
            "view": ViewSettings(patch_share=share, roll_deg=settings.roll_deg),
            "background": scene.settings.background.model_copy(update={"erasing": settings.erasing}),
            "camera": scene.settings.camera.model_copy(update={"file": None}),
        }
    )


def design_shares(scene: MeshScene, views: int = 256) -> np.ndarray:
    """The design's longer side over the picture's shorter one, in training views that see its face."""
    conditions, photo_px = scene.draw("train", views), scene.settings.camera.photo_px
    facing = np.abs(scene.piece_azimuth_deg(conditions)) < 90
    middle = np.array(scene.piece.size_mm) / 2
    scales = [local_scale(one, middle)[0] for one in scene.piece_homographies(conditions[facing], photo_px)]
    return np.array(scales) * max(scene.piece.design_rect_mm[2:]) / min(photo_px)


def shown_with_controls(problem: Problem, designs: dict[str, np.ndarray]) -> dict[str, Shown]:
    """What hangs on the object, by `KINDS`."""
    subject = problem.subject
    controls = {kind: subject.control(kind, designs["3d"]) for kind in ("grey", "noise")}
    with torch.no_grad():
        shown = {kind: subject.shown(from_pixels(one, problem.device)) for kind, one in designs.items()}
        shown |= {kind: subject.shown(from_pixels(one, problem.device), kind) for kind, one in controls.items()}
    return {kind: (shown | {"bare": None})[kind] for kind in KINDS}


def _found(problem: Problem, logits: dict[str, Tensor]) -> dict[str, dict[str, list]]:
    """Recognized and confidence per kind and condition."""
    classifier, indices = problem.classifiers[0], problem.indices[0]
    return {
        "recognized": {kind: classifier.recognized(one, indices).tolist() for kind, one in logits.items()},
        "confidence": {
            kind: [round(p, 6) for p in classifier.confidence(one, indices).tolist()] for kind, one in logits.items()
        },
    }


def picture_of(problem: Problem, twin: Problem, designs: dict[str, np.ndarray]) -> np.ndarray:
    """Side by side: the 2D design, an image with it, the object with it; the 3D design, the object with it."""
    tiles = []
    with torch.no_grad():
        for kind, worlds in (("2d", (twin, problem)), ("3d", (problem,))):
            tiles.append(enlarged(designs[kind], _TILE_PX))
            for one in worlds:
                shown = one.subject.shown(from_pixels(designs[kind], one.device))
                view = one.see(shown, one.scene.draw("evaluate", 1), _TILE_PX)
                tiles.append(as_pixels(expose(view, shown)[0]))
    return np.concatenate(tiles, 1)


def tables(settings: Patch3dSettings, results: Sequence[Result]) -> list[Table]:
    """Pooled, by mesh, by network and view, in the flat images, and cell by cell."""
    return [_pooled(results), _by_mesh(results), _by_view(settings, results), _in_images(results), _by_cell(results)]


def _pooled(results: Sequence[Result]) -> Table:
    groups = grouped(results, lambda one: (one.cell.values["scene"], one.cell.values["model"]))
    hard = {key: ones for key, ones in groups.items() if _mean(ones, "bare") <= HARD}
    rows = []
    for a, b in (("3d", "2d"), ("3d", "grey"), ("3d", "noise"), ("2d", "grey"), ("2d", "noise"), ("3d", "bare")):
        gains = [[_mean(ones, a) - _mean(ones, b) for ones in part.values()] for part in (groups, hard)]
        rows.append((f"{a} minus {b}", *(clustered(one) for one in gains)))
    about = (
        "Differences of the rate on the same conditions. The interval is a bootstrap over clusters, a cluster being an"
        " object before a network with all its seeds; n counts clusters, and fewer than 5 get none."
    )
    head = ("difference", "all clusters", f"clean rate up to {HARD:g}")
    return Table("pooled", "Pooled over objects, networks and seeds", head, tuple(rows), about)


def _by_mesh(results: Sequence[Result]) -> Table:
    rows = []
    for name, ones in grouped(results, lambda one: one.cell.values["scene"]).items():
        rows.append((Path(name).stem, *(_rate(ones, kind) for kind in KINDS), _paired(ones, "3d", "2d")))
    about = "Networks and seeds together; the difference is paired (Newcombe), as if all conditions were independent."
    return Table("meshes", "By object", ("object", *KINDS, "3d minus 2d"), tuple(rows), about)


def _by_view(settings: Patch3dSettings, results: Sequence[Result]) -> Table:
    groups: dict[tuple[str, str], dict[str, list[bool]]] = {}
    for one in results:
        for view, (low, high) in _views(settings, one).items():
            mine = [low <= azimuth <= high for azimuth in one.found["azimuth_deg"]]
            group = groups.setdefault((short(one.cell.values["model"]), view), {kind: [] for kind in KINDS})
            for kind in KINDS:
                hits = zip(one.found["recognized"][kind], mine, strict=True)
                group[kind] += [hit for hit, is_mine in hits if is_mine]
    rows = tuple(
        (*key, *(rate(group[kind]) for kind in KINDS), difference(group["3d"], group["2d"]))
        for key, group in groups.items()
    )
    about = "All objects and seeds; a view is a range of the camera's azimuth, right of the patch's side positive."
    return Table("views", "By network and view", ("network", "view", *KINDS, "3d minus 2d"), rows, about)


def _in_images(results: Sequence[Result]) -> Table:
    rows = []
    for name, ones in grouped(results, lambda one: one.cell.values["scene"]).items():
        where = "recognized_in_images"
        rows.append(
            (Path(name).stem, *(_rate(ones, kind, where) for kind in KINDS), _paired(ones, "2d", "grey", where))
        )
    about = (
        "The same designs in the 2D patch's own world: pasted at random places, sizes and angles into renders of the"
        " object over its backgrounds, held out from training where there are at least 20. These are renders, not"
        " photographs."
    )
    return Table("images", "Pasted into images", ("object", *KINDS, "2d minus grey"), tuple(rows), about)


def _by_cell(results: Sequence[Result]) -> Table:
    rows = tuple(
        (
            Path(one.cell.values["scene"]).stem,
            short(one.cell.values["model"]),
            one.cell.values["seed"],
            *(_mean([one], kind) for kind in KINDS),
            _paired([one], "3d", "2d"),
            one.found["passes"]["3d"],
            one.found["passes"]["2d"],
        )
        for one in results
    )
    head = ("object", "network", "seed", *KINDS, "3d minus 2d", "passes 3d", "passes 2d")
    return Table("cells", "Cell by cell", head, rows, "Passes are views that the network saw in training.")


def figures(settings: Patch3dSettings, results: Sequence[Result]) -> list[Drawing]:
    """Rates by object, 3D against 2D by cluster, and what was optimized."""
    meshes = grouped(results, lambda one: one.cell.values["scene"])
    firsts = [ones[0] for ones in meshes.values()]
    height = 1.3 * len(firsts) + 0.4
    return [
        Drawing("rates", "Rates by object", lambda figure: _draw_rates(figure, meshes), (7.5, 3.6)),
        Drawing(
            "scatter", "3D against 2D, a point per cell", lambda figure: _draw_scatter(figure, results), (4.4, 4.2)
        ),
        Drawing(
            "designs",
            "What was optimized: first network and seed of each object",
            lambda figure: _draw_designs(figure, firsts),
            (7.0, height),
            "2D design, pasted into an image, on the object; 3D design, on the object in the same view.",
        ),
    ]


def _draw_rates(figure, meshes: dict[str, list[Result]]) -> None:
    axes = figure.add_subplot()
    colors = ("#b8bcc2", "#8a8f98", "#5f6570", "#e09f3e", "#2a6f97")
    for i, (kind, color) in enumerate(zip(KINDS, colors, strict=True)):
        rates = [_rate(ones, kind) for ones in meshes.values()]
        x = np.arange(len(rates)) + (i - 2) * 0.16
        values = np.array([one.value for one in rates])
        spread = np.abs(np.array([[one.low, one.high] for one in rates]).T - values)
        axes.bar(x, values, 0.15, color=color, label=kind, yerr=spread, error_kw={"linewidth": 0.8})
    axes.set_xticks(range(len(meshes)), [Path(name).stem for name in meshes])
    axes.set_ylim(0, 1)
    axes.set_ylabel("rate")
    axes.legend(ncols=len(KINDS), loc="upper center", bbox_to_anchor=(0.5, 1.15), frameon=False)


def _draw_scatter(figure, results: Sequence[Result]) -> None:
    axes = figure.add_subplot()
    for model, ones in grouped(results, lambda one: one.cell.values["model"]).items():
        axes.plot(
            [_mean([o], "2d") for o in ones], [_mean([o], "3d") for o in ones], "o", label=short(model), alpha=0.7
        )
    axes.plot([0, 1], [0, 1], color="#8a8f98", linewidth=0.8)
    axes.set_xlabel("rate, optimized in 2D")
    axes.set_ylabel("rate, optimized in 3D")
    axes.legend(loc="lower right")


def _draw_designs(figure, firsts: Sequence[Result]) -> None:
    from matplotlib.image import imread

    for i, one in enumerate(firsts):
        axes = figure.add_subplot(len(firsts), 1, i + 1)
        axes.imshow(imread(one.out / one.found[f"{one.cell.name}.png"]))
        axes.set_title(one.cell.name, loc="left")
        axes.axis("off")


def _views(settings: Patch3dSettings, one: Result) -> dict[str, tuple[float, float]]:
    if settings.views:
        return dict(settings.views)
    edges = np.linspace(*one.found["azimuth_range_deg"], 4)
    return dict(zip(("left", "middle", "right"), itertools.pairwise(edges), strict=True))


def _hits(ones: Sequence[Result], kind: str, where: str = "recognized") -> list[bool]:
    return [hit for one in ones for hit in one.found[where][kind]]


def _mean(ones: Sequence[Result], kind: str) -> float:
    return float(np.mean(_hits(ones, kind)))


def _rate(ones: Sequence[Result], kind: str, where: str = "recognized") -> Estimate:
    return rate(_hits(ones, kind, where))


def _paired(ones: Sequence[Result], a: str, b: str, where: str = "recognized") -> Estimate:
    return difference(_hits(ones, a, where), _hits(ones, b, where))


STUDY = Study(
    "patch3d",
    "Patches optimized in 3D and in 2D, both on the object, under the same conditions.",
    Patch3dSettings,
    cells,
    run,
    tables,
    figures,
)
