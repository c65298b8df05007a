"""The classic 2D patch with the assistive goal: what it gains on its class, and what it does to every other class.

In: labeled images, scenes whose clean object is rendered where no photographs of a class exist, or both; networks,
seeds. A cell is a target, a network and a seed: a patch of `made_px` texels a side is optimized on images of the target
alone, at random places, sizes and angles, with Random Erasing of the picture below it, and shown `shown_px` wide at the
network's own size. Out: recognition with and without it, paired on the same images and places, for the target, and for
each other class by *its* labels, with how often the patch has it called the target: an assistive patch must not become
an adversarial one. Gray and noise of the same size are the controls.

Unlike a printed piece this patch has no frame of markers. With fewer than `SPLIT_FROM` images of a class it is measured
on those it was made with, and the table says so.
Sources: Pestana et al., supplement, algorithm 2; Brown et al., Adversarial Patch, 2017; Zhong et al., Random Erasing,
AAAI 2020.
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
from pydantic import Field, model_validator

from patchproof.channel.printer import load_printer
from patchproof.claims import Estimate, difference, rate
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.experiments.image_classes import ImageClass, classes_of, render_class
from patchproof.optimizer.loop import best_design
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem
from patchproof.render.photograph import Shown, expose
from patchproof.render.stage import set_stage
from patchproof.report.tables import Drawing, Table
from patchproof.scene.image_scene import SPLIT_FROM, ImageScene, largest_share, load_image_scene
from patchproof.settings import (
    BackgroundSettings,
    CameraSettings,
    ObjectSettings,
    OptimizeSettings,
    PatchSettings,
    PrinterSettings,
    SceneSettings,
    TargetSettings,
    ViewSettings,
)
from patchproof.sheets.piece import Piece
from patchproof.strict import Positive, PositiveRange, Range, Refused, Share, Strict, expand, nearest
from patchproof.study.study import Cell, Result, Study
from patchproof.study.trials import clustered, enlarged, grouped, logits_of, png_of, short

KINDS = ("bare", "grey", "noise", "patch")
_TILE_PX = 192


class Patch2dSettings(Strict):
    """Targets × models × seeds."""

    images: str | None = None  # a folder of images
    labels: str | None = None  # CSV: file name, label
    renders: tuple[str, ...] = ()  # scenes with meshes: each is one more class, its target's
    renders_each: Annotated[int, Field(ge=2)] = 64  # images of each of them
    targets: tuple[str | int, ...] = ()  # without any, every class
    models: Annotated[tuple[str, ...], Field(min_length=1)]  # each trains and tests its own patches
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)  # of the optimizer
    conditions: Annotated[int, Field(ge=1)] = 200  # per class and cell
    made_px: Annotated[int, Field(ge=8, le=512)] = 60  # side of the patch as it is optimized
    shown_px: Positive = 30.0  # its side in the network's input
    scale: PositiveRange = (0.8, 1.25)  # random, times shown_px
    roll_deg: Range = (-22.5, 22.5)  # as in Brown et al.'s published program
    erasing: Share = 0.5  # chance of Random Erasing in training
    printer: PrinterSettings = PrinterSettings()
    camera: CameraSettings = CameraSettings()
    optimize: OptimizeSettings = OptimizeSettings()

    @model_validator(mode="after")
    def _has_images(self):
        if (self.images is None) != (self.labels is None):
            raise ValueError("takes images and labels together")
        if self.images is None and not self.renders:
            raise ValueError("takes images and labels, or renders, or both")
        return self


def cells(settings: Patch2dSettings, base: Path) -> list[Cell]:
    """Targets × models × seeds; all targets with the first seed come first."""
    known = [one.label for one in classes_of(settings.images, settings.labels, settings.renders, base)]
    targets = settings.targets or tuple(dict.fromkeys(known))
    for target in targets:
        if target not in known:
            raise Refused("a target that there are images of", f'"{target}"', nearest(str(target), map(str, known)))
    return [
        Cell(f"target{i}-{short(model)}-{seed}", {"target": target, "model": model, "seed": seed})
        for seed, (i, target), model in itertools.product(settings.seeds, enumerate(targets), settings.models)
    ]


def run(settings: Patch2dSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """One patch, and every class with and without it."""
    classifier = load_classifier(expand(cell.values["model"], base), base)
    seed, classes = cell.values["seed"], classes_of(settings.images, settings.labels, settings.renders, base)
    target = next(one for one in classes if one.label == cell.values["target"])
    with tempfile.TemporaryDirectory() as folder:
        scenes = [class_scene(settings, base, one, classifier, seed, Path(folder)) for one in classes]
    problem = problem_of(settings, base, scenes[classes.index(target)], classifier, target)
    design = best_design(problem)
    shown = shown_with_controls(problem, design)
    found = [_class_found(problem, one, scene, shown, settings) for one, scene in zip(classes, scenes, strict=True)]
    return {
        "classes": found,
        "target": classes.index(target),
        f"{cell.name}.png": png_of(_picture(problem, scenes, design, shown["patch"])),
    }


def class_scene(
    settings: Patch2dSettings, base: Path, one: ImageClass, classifier: Classifier, seed: int, folder: Path
) -> ImageScene:
    """A scene of one class's images, in which the patch has no frame; renders are written to `folder`."""
    images, table = settings.images, settings.labels
    if one.scene is not None:
        images, table = render_class(one, base, seed, settings.renders_each, folder)
    scene = load_image_scene(scene_settings(settings, one, classifier, images, table), base, seed)
    side = float(settings.made_px)
    return replace(scene, piece=Piece((side, side), (0.0, 0.0, side, side), (), (), 1.0), sheet_id=f"patch2d:{seed}")


def scene_settings(
    settings: Patch2dSettings, one: ImageClass, classifier: Classifier, images: str, table: str
) -> SceneSettings:
    """A millimetre of the patch is one of its texels; its size in pictures follows from the network's own."""
    side = settings.made_px
    share = tuple(settings.shown_px * factor / classifier.input_px for factor in settings.scale)
    largest = largest_share((side, side), settings.roll_deg)
    if share[1] > largest:
        raise Refused(
            f"a patch of at most {largest * classifier.input_px:.0f} pixels before a network of {classifier.input_px}",
            f"shown_px = {settings.shown_px:g} times {settings.scale[1]:g}",
            "show it smaller",
        )
    return SceneSettings(
        object=ObjectSettings(images=images, labels=table),
        patch=PatchSettings(width_mm=side, height_mm=side),
        target=TargetSettings(label=one.label, accept=one.accept, models=(classifier.name,)),
        view=ViewSettings(patch_share=share, roll_deg=settings.roll_deg),
        background=BackgroundSettings(erasing=settings.erasing),
        printer=settings.printer,
        camera=settings.camera,
        optimize=settings.optimize,
    )


def problem_of(
    settings: Patch2dSettings, base: Path, scene: ImageScene, classifier: Classifier, one: ImageClass
) -> Problem:
    """A patch on images of its class."""
    stage, printer = set_stage(scene), load_printer(settings.printer.profile, base)
    subject = Patch(scene, printer, (settings.made_px, settings.made_px), stage.device)
    return Problem(scene, stage, printer, (classifier,), (_indices(classifier, one),), subject)


def shown_with_controls(problem: Problem, design: np.ndarray) -> dict[str, Shown]:
    """What is pasted, by `KINDS`."""
    subject = problem.subject
    pixels = {"patch": design} | {kind: subject.control(kind, design) for kind in ("grey", "noise")}
    with torch.no_grad():
        shown = {kind: subject.shown(from_pixels(one)) for kind, one in pixels.items()}
    return {kind: (shown | {"bare": None})[kind] for kind in KINDS}


def _class_found(
    problem: Problem, one: ImageClass, scene: ImageScene, shown: dict[str, Shown], settings: Patch2dSettings
) -> dict[str, Any]:
    """Per kind and condition: recognized by the class's own labels, and called the patch's target."""
    classifier, own, target = problem.classifiers[0], _indices(problem.classifiers[0], one), problem.indices[0]
    logits = logits_of(
        replace(problem, scene=scene, stage=set_stage(scene)), shown, scene.draw("evaluate", settings.conditions)
    )
    return {
        "name": classifier.labels[own[0]].partition(",")[0] + (" (renders)" if one.scene else ""),
        "images": len(scene.images),
        "same": bool(set(own) & set(target)),  # the target itself, or a class that its labels include
        "recognized": {kind: classifier.recognized(values, own).tolist() for kind, values in logits.items()},
        "called_target": {kind: classifier.recognized(values, target).tolist() for kind, values in logits.items()},
    }


def _indices(classifier: Classifier, one: ImageClass) -> tuple[int, ...]:
    return find_labels(classifier.labels, one.label, one.accept)


def _picture(problem: Problem, scenes: Sequence[ImageScene], design: np.ndarray, shown: Shown) -> np.ndarray:
    """Side by side: the patch, an image of its class with it, and up to three of other classes."""
    tiles = [enlarged(design, _TILE_PX)]
    others = [scene for scene in scenes if scene is not problem.scene][:3]
    with torch.no_grad():
        for scene in (problem.scene, *others):
            one = replace(problem, scene=scene, stage=set_stage(scene))
            tiles.append(as_pixels(expose(one.see(shown, scene.draw("evaluate", 1), _TILE_PX), shown)[0]))
    return np.concatenate(tiles, 1)


def tables(settings: Patch2dSettings, results: Sequence[Result]) -> list[Table]:
    """Gain on targets, harm on other classes, and both over all cells."""
    return [_pooled(results), _gains(results), _harm(results)]


def _gains(results: Sequence[Result]) -> Table:
    rows = []
    for (_, model), ones in _by_target(results):
        mine = [one.found["classes"][one.found["target"]] for one in ones]
        hits = {kind: _joined(mine, "recognized", kind) for kind in KINDS}
        rows.append(
            (
                mine[0]["name"],
                short(model),
                mine[0]["images"],
                mine[0]["images"] >= SPLIT_FROM,
                *(rate(hits[kind]) for kind in KINDS),
                difference(hits["patch"], hits["bare"]),
                difference(hits["patch"], hits["grey"]),
            )
        )
    about = (
        "Recognition of images of the patch's own class, seeds together. Where images are not held out, these are the"
        " images that the patch was made with, at new places. Classes marked as renders show renders of an object over"
        " backgrounds, since there are no photographs of it."
    )
    head = ("target", "network", "images", "held out", *KINDS, "patch minus bare", "patch minus grey")
    return Table("gain", "Gain on the target", head, tuple(rows), about)


def _harm(results: Sequence[Result]) -> Table:
    rows = []
    for (_, model), ones in _by_target(results):
        target = ones[0].found["classes"][ones[0].found["target"]]["name"]
        for i, other in enumerate(ones[0].found["classes"]):
            if other["same"]:
                continue
            mine = [one.found["classes"][i] for one in ones]
            own = {kind: _joined(mine, "recognized", kind) for kind in KINDS}
            called = {kind: _joined(mine, "called_target", kind) for kind in KINDS}
            rows.append(
                (
                    target,
                    short(model),
                    other["name"],
                    *(rate(own[kind]) for kind in ("bare", "grey", "patch")),
                    difference(own["patch"], own["bare"]),
                    difference(own["patch"], own["grey"]),
                    rate(called["patch"]),
                    difference(called["patch"], called["bare"]),
                )
            )
    about = (
        "Images of another class with the same patch. Recognized means its own labels; a negative difference is harm."
        " Called the target: the patch has made an adversarial example of it."
    )
    head = ("target", "network", "images of", "bare", "grey", "patch", "patch minus bare", "patch minus grey")
    head += ("called the target", "more than bare")
    return Table("harm", "Harm on each other class", head, tuple(rows), about)


def _pooled(results: Sequence[Result]) -> Table:
    own, others = [], []
    for _, ones in _by_target(results):
        own.append([one.found["classes"][one.found["target"]] for one in ones])
        others.append([other for one in ones for other in one.found["classes"] if not other["same"]])
    rows = []
    for name, groups, field in (
        ("target recognized", own, "recognized"),
        ("other classes recognized", others, "recognized"),
        ("other classes called the target", others, "called_target"),
    ):
        groups = [group for group in groups if group]
        rows.append((name, *(_clustered(groups, field, control) for control in ("bare", "grey", "noise"))))
    about = (
        "Mean differences of rates over targets and networks; the interval is a bootstrap over these clusters, each"
        " with all its seeds, images and other classes; n counts clusters, and fewer than 5 get none."
    )
    head = ("rate", "patch minus bare", "patch minus grey", "patch minus noise")
    return Table("pooled", "Over all targets and networks", head, tuple(rows), about)


def figures(settings: Patch2dSettings, results: Sequence[Result]) -> list[Drawing]:
    """Heat maps of what each patch does to each class, and what was made."""
    count, models = len(results[0].found["classes"]), list(dict.fromkeys(one.cell.values["model"] for one in results))
    targets = len({one.cell.values["target"] for one in results})
    firsts = [ones[0] for ones in grouped(results, lambda one: one.cell.values["target"]).values()]
    size = (1.6 + 0.75 * count, 1.4 + (0.5 * targets + 0.6) * len(models))
    about = "Rate with the patch minus rate without it, in points, by the image's own labels. Targets are framed."
    return [
        Drawing(
            "effect", "What each patch does to each class", lambda f: _draw_effect(f, results, models), size, about
        ),
        Drawing(
            "patches",
            "Patches, and images with them",
            lambda figure: _draw_patches(figure, firsts),
            (7.0, 1.6 * len(firsts) + 0.3),
            "The patch, its own class, and other classes; first network and seed of each target.",
        ),
    ]


def _draw_effect(figure, results: Sequence[Result], models: Sequence[str]) -> None:
    panels = figure.subplots(len(models), 1, squeeze=False)[:, 0]
    for axes, model in zip(panels, models, strict=True):
        groups = [ones for (_, its), ones in _by_target(results) if its == model]
        names = [one["name"] for one in results[0].found["classes"]]
        values = np.array([[_effect(ones, i) for i in range(len(names))] for ones in groups]) * 100
        axes.imshow(values, cmap="RdBu", vmin=-100, vmax=100, aspect="auto")
        for row, ones in enumerate(groups):
            for column in range(len(names)):
                value = values[row, column]
                color = "white" if abs(value) > 60 else "black"
                mark = "bold" if ones[0].found["classes"][column]["same"] else "normal"
                axes.text(column, row, f"{value:+.0f}", ha="center", va="center", color=color, weight=mark)
                if mark == "bold":
                    axes.add_patch(_frame(row, column))
        axes.set_xticks(range(len(names)), [name.replace(" (", "\n(") for name in names], fontsize=7)
        axes.set_yticks(range(len(groups)), [names[ones[0].found["target"]] for ones in groups], fontsize=7)
        axes.set_ylabel("patch for")
        axes.set_title(f"{short(model)}: images of", fontsize=9)


def _frame(row: int, column: int):
    from matplotlib.patches import Rectangle

    return Rectangle((column - 0.48, row - 0.46), 0.96, 0.92, fill=False, linewidth=1.2)


def _draw_patches(figure, firsts: Sequence[Result]) -> None:
    from matplotlib.image import imread

    for i, one in enumerate(firsts):
        axes = figure.add_subplot(len(firsts), 1, i + 1)
        axes.imshow(imread(one.out / one.found[f"{one.cell.name}.png"]))
        axes.set_title(one.found["classes"][one.found["target"]]["name"], loc="left")
        axes.axis("off")


def _by_target(results: Sequence[Result]) -> list[tuple[tuple[str | int, str], list[Result]]]:
    """Seeds together: ((target, network), results)."""
    return list(grouped(results, lambda one: (one.cell.values["target"], one.cell.values["model"])).items())


def _effect(ones: Sequence[Result], index: int) -> float:
    mine = [one.found["classes"][index] for one in ones]
    return float(np.mean(_joined(mine, "recognized", "patch")) - np.mean(_joined(mine, "recognized", "bare")))


def _joined(found: Sequence[dict], field: str, kind: str) -> list[bool]:
    return [hit for one in found for hit in one[field][kind]]


def _clustered(groups: Sequence[Sequence[dict]], field: str, control: str) -> Estimate | float | None:
    return clustered(
        [np.mean(_joined(group, field, "patch")) - np.mean(_joined(group, field, control)) for group in groups]
    )


STUDY = Study(
    "patch2d",
    "The classic 2D patch with the assistive goal: its gain on its class, its harm on every other.",
    Patch2dSettings,
    cells,
    run,
    tables,
    figures,
)
