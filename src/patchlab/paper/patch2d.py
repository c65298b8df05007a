"""The classic 2D patch with the assistive goal: its gain on its class, its harm on every other.

In: labeled images, scenes whose clean object is rendered where no photographs of a class exist, or both; networks,
seeds. A cell is a target, a network and a seed: a patch of `made_px` texels a side is optimized on images of the target
only, at random places, sizes and angles, with Random Erasing of the picture below it, and shown `shown_px` wide at the
network's input size. Out: recognition with and without it, paired on the same images and places, for the target, and
for each other class by its labels, with the rate at which the patch makes it the target: an assistive patch must not
become an adversarial one. Gray and noise of the same size are the controls. With `unrestricted`, a second patch is made
on images of all classes, to tell what the restriction saves the others.

Unlike a printed piece, this patch has no frame of markers. A class with fewer than `MIN_IMAGES_TO_SPLIT` images is
measured on those that the patch was made with, and the table says so.
Sources: Pestana et al., supplement, algorithm 2; Brown et al., Adversarial Patch, 2017; Zhong et al., Random Erasing,
AAAI 2020.
"""

import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from patchlab.paper.image_classes import ImageClass, PastedSettings, class_scene, list_classes
from patchlab.study.estimates import cluster_mean
from patchlab.study.figures import contact_sheet, enlarge_design, photographs, picture_sheet
from patchlab.study.grid import (
    Names,
    PositiveInt,
    Seeds,
    by_values,
    cached_network,
    group_by,
    make_cell,
    scene_values,
    short_name,
)
from patchlab.study.record import parse_hits, to_record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design
from patchproof.base.errors import Refused
from patchproof.base.intervals import estimate_difference, rate
from patchproof.base.validation import expand_path, spelling_hint
from patchproof.channel.printer import load_printer
from patchproof.classifier.labels import find_labels
from patchproof.classifier.network import Classifier
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import Appearance
from patchproof.render.stage import set_stage
from patchproof.report.tables import Drawing, Table
from patchproof.scene.image_scene import MIN_IMAGES_TO_SPLIT, ImageScene
from patchproof.scene.interface import Scene

KINDS = ("bare", "gray", "noise", "patch")
UNRESTRICTED = "unrestricted"  # a patch made on images of all classes
OWN_LABEL, TARGET_LABEL = 0, 1  # whose labels hits count for: the image's class, or the patch's target
_TILE_PX = 192


class Patch2dSettings(PastedSettings):
    """Settings: targets × networks × seeds."""

    targets: tuple[str | int, ...] = ()  # classes that patches are made for; by default all
    networks: Names  # networks, each of which trains alone
    seeds: Seeds = (0,)  # of draws
    n: PositiveInt = 200  # conditions per class and cell
    unrestricted: bool = False  # make a second patch on images of all classes, as Brown et al. do


def cells(settings: Patch2dSettings, base: Path) -> list[Cell]:
    """A cell per target, network and seed; all targets with the first seed come first."""
    renders = [scene_values(file, base) for file in settings.renders]
    known = [each.label for each in list_classes(settings.images, settings.labels, renders, base)]
    targets = settings.targets or tuple(dict.fromkeys(known))
    for target in targets:
        if target not in known:
            hint = spelling_hint(str(target), map(str, known))
            raise Refused("a target that there are images of", f'"{target}"', hint)
    cells = []
    for seed, (i, target), network in itertools.product(settings.seeds, enumerate(targets), settings.networks):
        name = short_name(network)
        values = {"name": f"target{i}", "target": target, "networks": [network], "network": name, "renders": renders}
        cells.append(make_cell(values, seed, name))
    return cells


def run(settings: Patch2dSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Make one patch, and show every class with and without it."""
    values, seed = cell.values, cell.values["seed"]
    classifier = cached_network(expand_path(values["networks"][0], base), base)
    classes = list_classes(settings.images, settings.labels, values["renders"], base)
    target = [each.label for each in classes].index(values["target"])
    with tempfile.TemporaryDirectory() as folder:
        scenes = [class_scene(settings, base, each, classifier, seed, Path(folder)) for each in classes]
    problem = flat_problem(settings, base, scenes[target], classifier, classes[target])
    design = best_design(problem)
    shown = pasted_by_kind(problem, design)
    if settings.unrestricted:
        training = tuple(image for scene in scenes for image in scene.images[: max(len(scene.images) // 2, 1)])
        # twice: an image scene holds out the second half of its images
        everything = replace(scenes[target], images=2 * training)
        other = best_design(flat_problem(settings, base, everything, classifier, classes[target]))
        shown[UNRESTRICTED] = problem.subject.appearance(from_pixels(other))
    pairs = zip(classes, scenes, strict=True)
    return {
        "classes": [_ask_about_class(problem, each, scene, shown, settings.n) for each, scene in pairs],
        "target": target,
        f"{cell.name}.png": _picture(problem, scenes, design, shown["patch"]),
    }


def flat_problem(
    settings: Patch2dSettings, base: Path, scene: ImageScene, classifier: Classifier, images_of: ImageClass
) -> Problem:
    """The problem of a patch on images of its class."""
    stage, printer = set_stage(scene), load_printer(settings.printer.profile, base)
    subject = Patch(scene, printer, (settings.made_px, settings.made_px), stage.device)
    return Problem(scene, stage, printer, (classifier,), (_indices(classifier, images_of),), subject, None)


def pasted_by_kind(problem: Problem, design: np.ndarray) -> dict[str, Appearance]:
    """Pasted pictures by `KINDS`; controls have no markers."""
    shown: dict[str, Appearance] = {"bare": None}
    with torch.no_grad():
        for kind in KINDS[1:]:
            pixels = design if kind == "patch" else problem.subject.control(kind, design)
            shown[kind] = problem.subject.appearance(from_pixels(pixels))
    return shown


def _with_scene(problem: Problem, scene: Scene) -> Problem:
    return replace(problem, scene=scene, stage=set_stage(scene))


def _ask_about_class(
    problem: Problem, images_of: ImageClass, scene: ImageScene, shown: Mapping[str, Appearance], n: int
) -> dict[str, Any]:
    """Hits by kind and condition, for the class's labels and for the patch's target."""
    (classifier,), (target,) = problem.classifiers, problem.indices
    own_indices = _indices(classifier, images_of)
    judged = replace(_with_scene(problem, scene), classifiers=(classifier, classifier), indices=(own_indices, target))
    return {
        "name": classifier.labels[own_indices[0]].partition(",")[0] + (" (renders)" if images_of.scene else ""),
        "images": len(scene.images),
        "same": bool(set(own_indices) & set(target)),  # the target itself, or a class that its labels include
        "hits": to_record(responses(judged, shown, scene.draw("evaluate", n)))["hits"],
    }


def _indices(classifier: Classifier, images_of: ImageClass) -> tuple[int, ...]:
    return find_labels(classifier.labels, images_of.label, images_of.accept)


def _picture(problem: Problem, scenes: Sequence[ImageScene], design: np.ndarray, shown: Appearance) -> bytes:
    """PNG of the patch, an image of its class with it, and up to three images of other classes with it."""
    worlds = (problem, *(_with_scene(problem, scene) for scene in scenes if scene is not problem.scene))[:4]
    tiles = [photographs(world, shown, world.scene.draw("evaluate", 1), _TILE_PX)[0] for world in worlds]
    return contact_sheet([[enlarge_design(design, _TILE_PX), *tiles]])


ClassAnswers = Mapping[str, Any]  # a cell's answers about one class


def tables(settings: Patch2dSettings, results: Sequence[Result]) -> list[Table]:
    """Tables of gain on targets, harm on other classes, and both over all cells."""
    return [_pooled(settings, results), _gains(results), _harm(results)]


def _gains(results: Sequence[Result]) -> Table:
    rows = []
    for (_, network), group in _by_target(results).items():
        answers = [_target_answers(result) for result in group]
        hits = {kind: _hits(answers, kind, OWN_LABEL) for kind in KINDS}
        start = (answers[0]["name"], network, answers[0]["images"], answers[0]["images"] >= MIN_IMAGES_TO_SPLIT)
        gains = (estimate_difference(hits["patch"], hits[control]) for control in ("bare", "gray"))
        rows.append((*start, *(rate(hits[kind]) for kind in KINDS), *gains))
    about = (
        "Recognition of images of the patch's own class, seeds together. Where images are not held out, these are the"
        " images that the patch was made with, at new places. Classes marked as renders show renders of an object over"
        " backgrounds, since there are no photographs of it."
    )
    head = ("target", "network", "images", "held out", *KINDS, "patch minus bare", "patch minus gray")
    return Table("gain", "Gain on the target", head, tuple(rows), about)


def _harm(results: Sequence[Result]) -> Table:
    rows = []
    for (_, network), group in _by_target(results).items():
        for i, other in enumerate(group[0].answers["classes"]):
            if other["same"]:
                continue
            of_class = [result.answers["classes"][i] for result in group]
            hits = {kind: _hits(of_class, kind, OWN_LABEL) for kind in KINDS}
            called, usual = (_hits(of_class, kind, TARGET_LABEL) for kind in ("patch", "bare"))
            rates = (rate(hits[kind]) for kind in ("bare", "gray", "patch"))
            harm = (estimate_difference(hits["patch"], hits[control]) for control in ("bare", "gray"))
            start = (_target_answers(group[0])["name"], network, other["name"])
            rows.append((*start, *rates, *harm, rate(called), estimate_difference(called, usual)))
    about = (
        "Images of another class with the same patch. Recognized means its own labels; a negative difference is harm."
        " Called the target: the patch has made an adversarial example of it."
    )
    head = ("target", "network", "images of", "bare", "gray", "patch", "patch minus bare", "patch minus gray")
    head += ("called the target", "more than bare")
    return Table("harm", "Harm on each other class", head, tuple(rows), about)


def _pooled(settings: Patch2dSettings, results: Sequence[Result]) -> Table:
    controls = (*KINDS[:3], UNRESTRICTED) if settings.unrestricted else KINDS[:3]
    groups = _by_target(results).values()
    targets = [[_target_answers(result) for result in group] for group in groups]
    others = [[each for result in group for each in result.answers["classes"] if not each["same"]] for group in groups]
    rows = []
    for name, clusters, which in (
        ("target recognized", targets, OWN_LABEL),
        ("other classes recognized", others, OWN_LABEL),
        ("other classes called the target", others, TARGET_LABEL),
    ):
        gains = ([_rate_difference(some, which, control) for some in clusters if some] for control in controls)
        rows.append((name, *map(cluster_mean, gains)))
    about = (
        "Mean differences of rates over targets and networks; the interval is a bootstrap over these clusters, each"
        " with all its seeds, images and other classes; n counts clusters, and fewer than 5 get none."
    )
    head = ("rate", *(f"patch minus {control}" for control in controls))
    return Table("pooled", "Over all targets and networks", head, tuple(rows), about)


def figures(settings: Patch2dSettings, results: Sequence[Result]) -> list[Drawing]:
    """Pictures of the patches (first network and seed of each target)."""
    firsts = [group[0] for group in group_by(results, by_values("target")).values()]
    files = [(_target_answers(first)["name"], first.file(f"{first.cell.name}.png")) for first in firsts]
    return [
        picture_sheet(
            "patches",
            "Patches, and images with them",
            files,
            (7.0, 1.6 * len(firsts) + 0.3),
            "The patch, its own class, and other classes; first network and seed of each target.",
        )
    ]


def _by_target(results: Sequence[Result]) -> dict[tuple, list[Result]]:
    return group_by(results, by_values("target", "network"))


def _target_answers(result: Result) -> ClassAnswers:
    return result.answers["classes"][result.answers["target"]]


def _hits(classes: Sequence[ClassAnswers], kind: str, which: int) -> list[bool]:
    return [hit for each in classes for hit in parse_hits(each["hits"][kind][which])]


def _rate_difference(classes: Sequence[ClassAnswers], which: int, control: str) -> float:
    return float(np.mean(_hits(classes, "patch", which)) - np.mean(_hits(classes, control, which)))


STUDY = Study("patch2d", Patch2dSettings, cells, run, tables, figures)
