"""Compare patches optimized in 3D and in 2D, both shown on the object under the same conditions.

In: scene files with meshes, networks, seeds. A cell is one of each: the scene's patch is optimized in 3D, as `optimize`
does, and again as the classic 2D patch: pasted flat at a random place, size and angle into renders of the same clean
object over the same backgrounds (renders, since most objects have no photographs), with Random Erasing. Design grid,
frame, printer, camera and number of classifier passes are the same; sizes in pixels come from the 3D views. Then both
are shown on the object, under conditions of the evaluate stream, beside the bare object, gray and noise.
Out: paired differences per condition, pooled, by mesh, and by network and view (where the camera stands); confidences
in three fixed views, each in a light of its own, as in the paper's table.

Left out on purpose: the 2D patch knows neither light nor place, since images do not tell them. Both designs are also
shown in held-out images, which tells if the 2D patch is weak there, too.
Sources: Pestana et al., algorithm "Masked Textures and 3D Patches" and the table of 2D and 3D patches by model and
view, supplement algorithm 2 (2D patch); Brown et al., Adversarial Patch, 2017.
"""

import itertools
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from patchlab.harden.labeled_photos import write_labels
from patchlab.paper.image_classes import write_renders
from patchlab.study import grid
from patchlab.study.estimates import cluster_mean
from patchlab.study.figures import contact_sheet, enlarge_design, photographs, picture_sheet
from patchlab.study.grid import views_per_network
from patchlab.study.record import Record, parse_hits, to_record
from patchlab.study.study import Cell, Result, Study
from patchlab.study.trained_designs import best_design, views_in_drawn_light
from patchproof.base.errors import Refused
from patchproof.base.intervals import estimate_difference, rate
from patchproof.base.settings import ObjectSettings, PatchSettings, SceneSettings, ViewSettings
from patchproof.base.validation import Range, Share
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.problem import Problem
from patchproof.optimizer.promise import pictures_with_controls
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import from_pixels
from patchproof.render.photograph import Appearance
from patchproof.render.stage import set_stage
from patchproof.report.page import png
from patchproof.report.tables import Drawing, Table
from patchproof.scene.image_scene import build, largest_share
from patchproof.scene.interface import SceneSource
from patchproof.scene.patch_scene import PatchScene, require_patch

KINDS = ("bare", "gray", "noise", "2d", "3d")
MAX_MISREAD_RATE = 0.2  # clean rate up to which an object counts as misread by the network
_TILE_PX = 192
_SIZE_QUANTILES = (0.05, 0.95)  # of the design's sizes in 3D views; its sizes in 2D lie between them


class Patch3dSettings(grid.GridSettings):
    """Scenes, networks, seeds and the 2D patch; each scene's [optimize] sets the training."""

    seeds: grid.Seeds = (0, 1, 2)  # of the scenes' draws
    n: grid.PositiveInt = 200  # conditions per cell, of the evaluate stream
    n_in_images: grid.PositiveInt | None = None  # images per cell with a patch pasted in; by default as many
    renders: Annotated[int, Field(ge=2)] = 64  # images of the clean object; half of 20 or more are held out
    roll_deg: Range = (-22.5, 22.5)  # roll of the 2D patch, as in Brown et al.'s program
    erasing: Share = 0.5  # chance of Random Erasing in 2D training
    # Ranges of azimuth in degrees, by name; by default thirds of each scene's range.
    views: dict[str, Range] = Field(default_factory=dict)


def cells(settings: Patch3dSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed."""
    return patch_cells(settings, base)


def patch_cells(settings: grid.GridSettings, base: Path) -> list[Cell]:
    """A cell per scene, network and seed; refuses scenes without a mesh or a printed patch. All objects with the first
    seed come first, so that an unfinished study covers each.
    """
    cells = grid.grid_cells(settings, base)
    for cell in cells:
        scene, do = cell.values["scene"], 'give object.mesh and patch.kind = "patch"'
        if scene["object"]["mesh"] is None or scene["patch"]["kind"] != "patch":
            raise Refused("a scene with a mesh and a printed patch", cell.values["file"], do)
    return sorted(cells, key=lambda cell: settings.seeds.index(cell.values["seed"]))


def run(settings: Patch3dSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Optimize for one object, network and seed in 3D and in 2D, and measure both designs in both."""
    problem = grid.problem_of(base, cell.values)
    with tempfile.TemporaryDirectory() as folder:
        twin = flat_twin(problem, settings, Path(folder))
    designs = {"3d": best_design(problem), "2d": best_design(twin)}
    worlds = {"3d": problem, "2d": twin}
    conditions = problem.scene.draw("evaluate", settings.n)
    in_images = twin.scene.draw("evaluate", settings.n_in_images or settings.n)
    on_object = appearances_by_kind(problem, designs)
    return {
        **to_record(responses(problem, on_object, conditions)),
        "three": to_record(responses(problem, on_object, views_in_drawn_light(problem, 1))),
        "in_images": to_record(responses(twin, appearances_by_kind(twin, designs), in_images)),
        "azimuth_deg": conditions.pose.azimuth_deg.tolist(),
        "azimuth_range_deg": problem.scene.settings.view.azimuth_deg,
        "passes": {name: views_per_network(world.scene.settings.optimize) for name, world in worlds.items()},
        "share": twin.scene.settings.view.patch_share,
        "warnings": list(problem.scene.warnings),
        f"{cell.name}.png": compose_picture(problem, twin, designs),
        f"{cell.name}-2d.png": png(designs["2d"]),
        f"{cell.name}-3d.png": png(designs["3d"]),
    }


def flat_twin(problem: Problem, settings: Patch3dSettings, folder: Path) -> Problem:
    """The problem of the classic 2D patch: its scene has renders of the object, which are written to `folder`."""
    scene = require_patch(problem.scene, "a printed patch on a mesh")
    names = write_renders(problem.stage, settings.renders, problem.training_px, folder)
    write_labels([(name, scene.settings.target.label) for name in names], folder)
    flat = build(SceneSource(flat_settings(scene, settings), folder, scene.seed))
    pasted = Patch(flat, problem.printer, problem.patch.design_px, problem.device)
    return replace(problem, scene=flat, stage=set_stage(flat, problem.device), subject=pasted)


def flat_settings(scene: PatchScene, settings: Patch3dSettings) -> SceneSettings:
    """Settings of a scene of images with the printer, camera and optimizer of a mesh scene, and its patch as large."""
    width, height = scene.piece.size_mm
    patch = PatchSettings(width_mm=width, height_mm=height)
    low, high = np.quantile(design_shares(scene), _SIZE_QUANTILES)
    largest = largest_share(settings.roll_deg)
    share = (float(min(low, largest)), float(min(high, largest)))
    return scene.settings.changed(
        object=ObjectSettings(images=".", labels="labels.csv"),
        patch=patch,
        view=ViewSettings(patch_share=share, roll_deg=settings.roll_deg),
        background={"erasing": settings.erasing},
        camera={"file": None},
    )


def design_shares(scene: PatchScene, views: int = 256) -> np.ndarray:
    """The piece's longer side over the picture's shorter one, in training views that face it."""
    conditions, photo_px = scene.draw("train", views), scene.settings.camera.photo_px
    scales = scene.piece_scales(conditions[scene.facing(conditions)], photo_px)
    return scales * max(scene.piece.size_mm) / min(photo_px)


def appearances_by_kind(problem: Problem, designs: Mapping[str, np.ndarray]) -> dict[str, Appearance]:
    """Appearances of the object by `KINDS`."""
    things = pictures_with_controls(problem, designs["3d"], KINDS[:3])
    things |= {"2d": problem.subject.appearance(from_pixels(designs["2d"], problem.device)), "3d": things["design"]}
    return {kind: things[kind] for kind in KINDS}


def compose_picture(problem: Problem, twin: Problem, designs: Mapping[str, np.ndarray]) -> bytes:
    """PNG of the 2D design, an image with it, the object with it; the 3D design, the object with it."""
    tiles = []
    for kind, worlds in (("2d", (twin, problem)), ("3d", (problem,))):
        tiles.append(enlarge_design(designs[kind], _TILE_PX))
        for world in worlds:
            shown = world.subject.appearance(from_pixels(designs[kind], world.device))
            tiles.append(photographs(world, shown, world.scene.draw("evaluate", 1), _TILE_PX)[0])
    return contact_sheet([tiles])


def tables(settings: Patch3dSettings, results: Sequence[Result]) -> list[Table]:
    """Tables: pooled, by object, by network and view, pasted into images, and by cell."""
    objects, images = _by_object(results, ("3d", "2d"), None), _by_object(results, ("2d", "gray"), "in_images")
    about = "Networks and seeds together; the difference is paired (Newcombe), as if all conditions were independent."
    in_images = (
        "The same designs in the 2D patch's own world: pasted at random places, sizes and angles into renders of the"
        " object over its backgrounds, held out from training where there are at least 20. These are renders, not"
        " photographs."
    )
    return [
        _pooled(results),
        Table("meshes", "By object", ("object", *KINDS, "3d minus 2d"), objects, about),
        _by_view(settings, results),
        _in_three_views(results),
        Table("images", "Pasted into images", ("object", *KINDS, "2d minus gray"), images, in_images),
        _by_cell(results),
    ]


def _pooled(results: Sequence[Result]) -> Table:
    groups = grid.group_by(results, grid.by_values("name", "network"))
    hard = {key: group for key, group in groups.items() if _mean_rate(group, "bare") <= MAX_MISREAD_RATE}
    rows = []
    for a, b in (("3d", "2d"), ("3d", "gray"), ("3d", "noise"), ("2d", "gray"), ("2d", "noise"), ("3d", "bare")):
        gains = [[_mean_rate(group, a) - _mean_rate(group, b) for group in some.values()] for some in (groups, hard)]
        rows.append((f"{a} minus {b}", *map(cluster_mean, gains)))
    about = (
        "Differences of the rate on the same conditions. The interval is a bootstrap over clusters, a cluster being an"
        " object before a network with all its seeds; n counts clusters, and fewer than 5 get none."
    )
    head = ("difference", "all clusters", f"clean rate up to {MAX_MISREAD_RATE:g}")
    return Table("pooled", "Pooled over objects, networks and seeds", head, tuple(rows), about)


def _by_object(results: Sequence[Result], pair: tuple[str, str], where: str | None) -> tuple[tuple, ...]:
    rows = []
    for name, group in grid.by_scene(results).items():
        records = {kind: Record(group, kind, where) for kind in KINDS}
        rates = (record.level()[0] for record in records.values())
        rows.append((name, *rates, records[pair[0]].gain(records[pair[1]])[0]))
    return tuple(rows)


def _by_view(settings: Patch3dSettings, results: Sequence[Result]) -> Table:
    groups: dict[tuple[str, str], dict[str, list[bool]]] = {}
    for result in results:
        for view, (low, high) in _view_ranges(settings, result).items():
            group = groups.setdefault((result.cell.values["network"], view), {kind: [] for kind in KINDS})
            for kind in KINDS:
                hits = zip(parse_hits(result.answers["hits"][kind][0]), result.answers["azimuth_deg"], strict=True)
                group[kind] += [hit for hit, azimuth in hits if low <= azimuth <= high]
    rows = tuple(
        (*key, *(rate(group[kind]) for kind in KINDS), estimate_difference(group["3d"], group["2d"]))
        for key, group in groups.items()
    )
    about = "All objects and seeds; a view is a range of the camera's azimuth, right of the patch's side positive."
    return Table("views", "By network and view", ("network", "view", *KINDS, "3d minus 2d"), rows, about)


def _in_three_views(results: Sequence[Result]) -> Table:
    rows = []
    for key, group in grid.group_by(results, grid.by_values("name", "network")).items():
        for kind in ("bare", "2d", "3d"):
            record = Record(group, kind, "three")
            right, sure = (np.reshape(each, (-1, 3)) for each in (record.hits(), record.confidences()))
            seen = *map(int, right.sum(0)), *map(float, sure.mean(0)), rate(right.ravel().tolist())
            rows.append((*key, kind, len(right), *seen))
    places = ("left", "middle", "right")
    head = ("object", "network", "shown", "seeds", *(f"{place} right" for place in places), *places, "recognized")
    about = "Three fixed views, each in a light of its own by seed: seeds that recognize it, and the mean confidence."
    return Table("three", "Three views with a light each", head, tuple(rows), about)


def _by_cell(results: Sequence[Result]) -> Table:
    rows = []
    for result in results:
        gain = Record([result], "3d").gain(Record([result], "2d"))[0]
        passes = result.answers["passes"]
        rates = (_mean_rate([result], kind) for kind in KINDS)
        rows.append((*grid.cell_key(result), *rates, gain, passes["3d"], passes["2d"]))
    head = ("object", "network", "seed", *KINDS, "3d minus 2d", "passes 3d", "passes 2d")
    return Table("cells", "Cell by cell", head, tuple(rows), "Passes are views that the network saw in training.")


def figures(settings: Patch3dSettings, results: Sequence[Result]) -> list[Drawing]:
    """Pictures of the designs (first network and seed of each object)."""
    firsts = [group[0] for group in grid.by_scene(results).values()]
    return [
        picture_sheet(
            "designs",
            "What was optimized: first network and seed of each object",
            [(first.cell.name, first.file(f"{first.cell.name}.png")) for first in firsts],
            (7.0, 1.3 * len(firsts) + 0.4),
            "2D design, pasted into an image, on the object; 3D design, on the object in the same view.",
        )
    ]


def _view_ranges(settings: Patch3dSettings, result: Result) -> dict[str, tuple[float, float]]:
    if settings.views:
        return dict(settings.views)
    first, last = result.answers["azimuth_range_deg"]
    edges = np.linspace(first, last, 4).tolist()
    return dict(zip(("left", "middle", "right"), itertools.pairwise(edges), strict=True))


def _mean_rate(results: Sequence[Result], kind: str) -> float:
    return float(np.mean(Record(results, kind).hits()))


STUDY = Study("patch3d", Patch3dSettings, cells, run, tables, figures)
