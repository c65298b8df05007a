"""How the rasterizer's time and memory grow, and what share of a training step rendering takes.

In: a problem. Out: charts. The growth is measured on spheres of icosahedron faces, which fill a picture evenly. Shares
are of the classifier's own forward and backward pass on the same pictures in the same run. Where the environment names
a folder of real networks and meshes (PATCHPROOF_DATA), one of each is measured, too.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch

from patchproof.bench.chart import Chart, Check, Growth, OnStage, Point, Series, Shares
from patchproof.bench.measure import median_interval, slope, timed
from patchproof.goal import Goal
from patchproof.mesh.load_mesh import load_mesh
from patchproof.optimizer.goals import target_loss
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.render.fragments import Cameras
from patchproof.render.photograph import expose
from patchproof.render.raster import rasterize
from patchproof.scene.scene import build_scene
from patchproof.settings import SceneSettings

SUBDIVISIONS = (3, 4, 5, 6, 7, 8)  # 1.3 thousand to 1.3 million faces
GROWTH_FACES = 5  # subdivisions where something else grows: 20 thousand faces
GROWTH_SIDES_PX = (128, 256, 512, 1024, 2048)
GROWTH_VIEWS = (1, 2, 4, 8, 16, 32)
SIDE_PX, STEP_VIEWS = 224, 15
MEMORY_SIDE_PX = 1024
STEEPEST = 1.1  # linear, with room for timing
_REAL = ("models/mobilenet_v2_1.0_224.pt2", "meshes/gz_suv.glb", "meshes/spot.glb")
_NEAR_MM = 0.5
_WHOLE, _SPOT = "all of these", "rasterizing spot.glb"
MOST_GB, MOST_SHARE, MOST_RASTER_SHARE = 1.5, 12.0, 10.0


def growth_chart(quick: bool, on_stage: OnStage) -> Chart:
    """Time of `rasterize` against faces, and against fragments as pictures and batches grow."""
    peak = peak_gb(STEP_VIEWS, MEMORY_SIDE_PX)
    subdivisions = SUBDIVISIONS[: len(SUBDIVISIONS) - 2 * quick]
    sides, views = (sizes[: len(sizes) - quick] for sizes in (GROWTH_SIDES_PX, GROWTH_VIEWS))
    tasks = [
        (f"faces, {SIDE_PX} px", [(n, 1, SIDE_PX) for n in subdivisions]),
        ("fragments, larger pictures", [(GROWTH_FACES, 1, side) for side in sides]),
        (f"fragments, more views of {SIDE_PX} px", [(GROWTH_FACES, n, SIDE_PX) for n in views]),
    ]
    series = []
    for i, (label, sizes) in enumerate(tasks):
        series.append(_growth(label, sizes, 2 if quick else 7, of_faces=i == 0))
        on_stage("growth", i + 1, len(tasks))
    checks = [Check(f"slope of {one.label}", one.slope, STEEPEST) for one in series]
    if peak is not None:
        claim = f"peak memory of rasterizing {STEP_VIEWS} views of {MEMORY_SIDE_PX} px in a process of its own, GB"
        checks.append(Check(claim, peak, MOST_GB))
    return Growth(
        "growth",
        "How the rasterizer's time grows",
        "faces or fragments",
        "seconds",
        tuple(series),
        (f"spheres; fragments with {20 * 4**GROWTH_FACES} faces; slopes over the larger half of the sizes",),
        tuple(checks),
    )


def _growth(label: str, sizes: list[tuple[int, int, int]], rounds: int, of_faces: bool) -> Series:
    """Times of spheres of (subdivisions, views, side in pixels)."""
    works = [sphere(*size) for size in sizes]
    counts = [len(faces) if of_faces else len(rasterize(v, faces, *rest)) for v, faces, *rest in works]
    seconds = timed({i: lambda work=work: rasterize(*work) for i, work in enumerate(works)}, rounds)
    points = []
    for size, count, times in zip(sizes, counts, seconds.values(), strict=True):
        middle, interval = median_interval(times)
        name = f"{count:,} faces" if of_faces else f"{size[1]} × {size[2]}²"
        points.append(Point(name, count, middle, (count, count), interval))
    return Series(label, tuple(points), slope([p.cost for p in points], [p.error for p in points]))


def sphere(subdivisions: int, views: int, side_px: int) -> tuple:
    """What `rasterize` takes for a sphere that fills two thirds of each picture's side, seen from different sides."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    angle = torch.arange(views, dtype=torch.float64) * 0.7
    poses = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    poses[:, 0, 0], poses[:, 0, 2], poses[:, 2, 0], poses[:, 2, 2] = angle.cos(), angle.sin(), -angle.sin(), angle.cos()
    poses[:, 2, 3] = 3.2
    matrix = torch.tensor([[side_px, 0, side_px / 2], [0, side_px, side_px / 2], [0, 0, 1]], dtype=torch.float64)
    cameras = Cameras(poses, matrix.expand(views, 3, 3), (side_px, side_px))
    return torch.tensor(ball.vertices), torch.tensor(ball.faces), cameras, 0.01


def peak_gb(views: int, side_px: int) -> float | None:
    """Peak memory of a fresh process that rasterizes a sphere of 20 thousand faces; None where no system tells."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_own_peak_gb, views, side_px).result()


def _own_peak_gb(views: int, side_px: int) -> float | None:
    rasterize(*sphere(GROWTH_FACES, views, side_px))
    status = Path("/proc/self/status")
    if status.is_file():  # Linux: getrusage would count what the parent held before this program was started
        line = next(line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024 / 1e9
    try:
        import resource
    except ModuleNotFoundError:
        return None
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e9 if sys.platform == "darwin" else 1e6)


def step_chart(problem: Problem, rounds: int, on_stage: OnStage) -> Chart:
    """The parts of a step on 15 views as shares of the classifier's forward and backward pass on the same pictures."""
    rows, notes, checks = {f"truck, {problem.classifiers[0].name}": step_shares(problem, rounds)}, [], []
    on_stage("step", 1, 2)
    folder = Path(os.environ.get("PATCHPROOF_DATA", "."))
    network, suv, spot = (folder / name for name in _REAL)
    if "PATCHPROOF_DATA" in os.environ and all(path.is_file() for path in (network, suv, spot)):
        real = set_problem(build_scene(_real_scene(suv, network), Path()))
        shares = step_shares(real, rounds, spot=_fragments_of(real, spot))
        rows[f"{suv.stem}, {network.stem}"] = shares
        whole, alone = (float(np.median(shares[part])) for part in (_WHOLE, _SPOT))
        checks.append(Check(f"rendering {STEP_VIEWS} views of {suv.name}, % of {network.stem}", whole, MOST_SHARE))
        checks.append(Check(f"rasterizing {spot.name} alone, % of the same", alone, MOST_RASTER_SHARE))
    else:
        notes.append(f"real networks and meshes not measured: PATCHPROOF_DATA names no folder with {', '.join(_REAL)}")
    on_stage("step", 2, 2)
    series = []
    for label, shares in rows.items():
        spans = {part: median_interval(values) for part, values in shares.items()}
        series.append(Series(label, tuple(Point(part, m, 0.0, span, (0.0, 0.0)) for part, (m, span) in spans.items())))
    title = f"Share of a training step on {STEP_VIEWS} views"
    label = "% of the classifier's own forward + backward, same run"
    return Shares("step", title, label, "", tuple(series), tuple(notes), tuple(checks))


def step_shares(problem: Problem, rounds: int, spot: Callable[[], object] | None = None) -> dict[str, np.ndarray]:
    """Per round, per cent of the classifier's forward and backward pass; rendered at the problem's training size."""
    conditions, side = problem.scene.draw("train", STEP_VIEWS), problem.training_px
    surface, size_px = problem.stage.object, (side, side)
    poses = torch.as_tensor(problem.scene.camera_from_world(conditions))
    cameras = Cameras(poses, torch.as_tensor(problem.scene.matrix_px(size_px)).expand(STEP_VIEWS, 3, 3), size_px)
    design, made = problem.subject.start().requires_grad_(), {}

    def printed() -> None:
        made["shown"] = problem.subject.shown(design)

    def see() -> None:
        made["seen"] = problem.see(made["shown"], conditions, side)

    def shade() -> None:
        made["pictures"] = expose(made["seen"], made["shown"])

    def backward() -> None:
        torch.autograd.grad(made["pictures"].mean(), design)

    def network() -> None:
        pictures = made["pictures"].detach().requires_grad_()
        logits = problem.classifiers[0].logits(pictures)
        torch.autograd.grad(target_loss(logits, problem.indices[0], Goal.assist).mean(), pictures)

    def alone() -> None:
        rasterize(surface.vertices, surface.faces, cameras, _NEAR_MM)

    calls = {"print": printed, "see": see, "shade": shade, "backward": backward, "network": network}
    calls["rasterizing alone"] = alone
    seconds = timed(calls | ({} if spot is None else {_SPOT: spot}), rounds)
    whole = seconds.pop("network")
    parts = ("print", "see", "shade", "backward")
    seconds = {part: seconds[part] for part in parts} | {_WHOLE: sum(seconds[part] for part in parts)} | seconds
    return {name: 100 * values / whole for name, values in seconds.items()}


def _fragments_of(problem: Problem, path: Path) -> Callable[[], object]:
    """Rasterizing another object of the same length from the same cameras."""
    mesh = load_mesh(path, problem.scene.settings.object.length_mm)
    vertices, faces = torch.as_tensor(mesh.vertices), torch.as_tensor(mesh.faces)
    poses = torch.as_tensor(problem.scene.camera_from_world(problem.scene.draw("train", STEP_VIEWS)))
    size_px = (problem.training_px, problem.training_px)
    matrix = torch.as_tensor(problem.scene.matrix_px(size_px)).expand(STEP_VIEWS, 3, 3)
    return lambda: rasterize(vertices, faces, Cameras(poses, matrix, size_px), _NEAR_MM)


def _real_scene(mesh: Path, network: Path) -> SceneSettings:
    return SceneSettings.model_validate(
        {
            "object": {"mesh": str(mesh), "length_mm": 480},
            "patch": {"width_mm": 110, "height_mm": 110},
            "target": {"label": "jeep", "models": [f"file:{network}"]},
        }
    )
