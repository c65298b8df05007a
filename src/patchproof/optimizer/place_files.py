"""Files of a search for a place: `place.json`, and `place.png` to look at.

In: a `Place` and the scene with the piece there. Out: both files, and the place read back. The picture shows the object
from four directions across the scene's azimuths, each place as a small square from yellow (the best) to purple (the
worst), the drafted ones with their rank, and the chosen piece's outline at its size; the title says so.
"""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from patchproof.base import geometry
from patchproof.base.color import photo_codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, read_json
from patchproof.base.output import write_atomically
from patchproof.base.validation import validate_model
from patchproof.channel.effects import Light, Pose
from patchproof.optimizer.place_search import Place
from patchproof.render.photograph import on_white, shade
from patchproof.render.raster import rasterize
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import NEAR_SHARE, cameras, render_views
from patchproof.scene.conditions import Conditions
from patchproof.scene.patch_scene import PatchScene, PiecePosition, UnplacedScene
from patchproof.scene.placement import SurfaceFrame, patch_frame, side_frame

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RECORD_FILE, _PICTURE_FILE = "place.json", "place.png"
_DIRECTIONS, _SIDE_PX = 4, 420
_MARGIN = 1.05  # times the object's diagonal
_IN_FRONT_MM = 2.0  # a square's middle at most this deep behind the surface is visible
_CHOSEN_COLOR = "#e6005a"


def save_place(place: Place, scene: PatchScene, folder: Path) -> None:
    """Write both files; `scene` has the piece at the place."""
    write_atomically(folder / _RECORD_FILE, place.model_dump_json(indent=1) + "\n")
    figure = _draw(place, scene)
    write_atomically(folder / _PICTURE_FILE, lambda path: figure.savefig(path, format="png"))


def read_place(folder: Path, scene: UnplacedScene | None = None) -> Place | None:
    """The place in a run's folder; None if there is none, refused if it was searched in another `scene`."""
    path = folder / _RECORD_FILE
    if not is_file(path):
        return None
    place = validate_model(Place, read_json(path, "the record of a search", "start in another folder"), str(path))
    if scene is not None and place.sheet_id != scene.sheet_id:
        do = "resume with the same scene file and seed, or start in another folder"
        got = f"a place of sheet {place.sheet_id} in {folder}, not {scene.sheet_id}"
        raise Refused("the place of this scene and seed", got, do)
    return place


def _draw(place: Place, scene: PatchScene) -> "Figure":
    """Draw the object with all candidates and the piece's outline, from four directions."""
    from matplotlib.figure import Figure

    scene, conditions = _even_scene(scene)
    stage, size, poses = set_stage(scene), (_SIDE_PX, _SIDE_PX), scene.camera_from_world(conditions)
    with torch.no_grad():
        light = shade(render_views(stage, None, conditions, size), None)
    pictures = photo_codes_from_srgb(srgb_from_linear(light.clamp(0, 1)).permute(0, 2, 3, 1).numpy())
    placement, frames = scene.placement, [_frame(scene, each.at) for each in place.candidates]
    border = geometry.rect_border((0, 0, *placement.size_mm), 16)  # bent paper has bent edges
    outline = placement.world(np.concatenate([border, border[:1]]))
    figure = Figure(figsize=(4 * _DIRECTIONS, 4.4), layout="constrained")
    drafted = sum(candidate.draft is not None for candidate in place.candidates)
    numbers = f"1 to {drafted}: drafted, by rank; " if drafted else ""
    ranks = f"{len(frames)} places from yellow (the best) to purple (the worst)"
    figure.suptitle(f"{ranks}; {numbers}outline: the piece where it goes")
    for axes, pose, picture in zip(figure.subplots(1, _DIRECTIONS), poses, pictures, strict=True):
        axes.imshow(picture, extent=(0, _SIDE_PX, _SIDE_PX, 0))
        axes.set_axis_off()
        project, eye = partial(geometry.project, scene.matrix_px(size), pose), geometry.camera_centers(pose[None])[0]
        depth = _depth(stage, scene, pose)
        visible = [i for i, each in enumerate(frames) if _is_visible(project, pose, depth, eye, each)][::-1]
        x, y = project(np.array([frames[i].origin_mm for i in visible]).reshape(-1, 3)).T
        looks = {"marker": "s", "cmap": "viridis_r", "edgecolors": "black"}
        axes.scatter(x, y, 200, visible, vmin=0, vmax=max(len(frames) - 1, 1), **looks)
        for k, i in ((k, i) for k, i in enumerate(visible) if i < drafted):
            axes.text(x[k], y[k], f"{i + 1}", ha="center", va="center")
        if placement.normal @ (eye - placement.center_mm) > 0:
            axes.plot(*project(outline).T, color=_CHOSEN_COLOR, linewidth=3)
    return figure


def _frame(scene: PatchScene, at: PiecePosition) -> SurfaceFrame:
    patch = scene.settings.patch
    return side_frame(scene.mesh, at) if isinstance(at, str) else patch_frame(scene.mesh, patch.changed(at_mm=at))


def _even_scene(scene: PatchScene) -> tuple[PatchScene, Conditions]:
    """The scene in even light on white, zoomed to the whole object, and the directions it is seen from."""
    view = scene.settings.view
    distance = sum(view.distance_mm) / 2
    half = float(np.linalg.norm(np.ptp(scene.mesh.vertices, axis=0))) / 2 * _MARGIN
    fov = float(np.degrees(2 * np.arctan(half / distance)))
    (low, high), ones = view.azimuth_deg, np.ones(_DIRECTIONS)
    pose = Pose(
        azimuth_deg=low + (high - low) * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS,
        elevation_deg=ones * sum(view.elevation_deg) / 2,
        distance_mm=ones * distance,
    )
    light = Light(ambient=ones * 0.55, directional=ones * 0.45, light_elevation_deg=ones * 45)
    return on_white(scene, (_SIDE_PX, _SIDE_PX), fov_deg=fov), Conditions(pose=pose, light=light)


def _is_visible(project: Any, pose: np.ndarray, depth: np.ndarray, eye: np.ndarray, frame: SurfaceFrame) -> bool:
    """True if a place faces the camera and nothing is in front of it."""
    if frame.normal @ (eye - frame.origin_mm) <= 0:
        return False
    x, y = np.floor(project(frame.origin_mm[None])[0]).astype(int)
    inside = 0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]
    return inside and bool((pose[:3] @ [*frame.origin_mm, 1])[2] < depth[y, x] + _IN_FRONT_MM)


def _depth(stage: Stage, scene: PatchScene, pose: np.ndarray) -> np.ndarray:
    """H×W distances of the object from the camera along its axis, infinite beside the object."""
    surface, size = stage.object_surface, (_SIDE_PX, _SIDE_PX)
    frames = cameras(pose[None], scene.matrix_px(size)[None], size, stage)
    fragments = rasterize(surface.vertices, surface.faces, frames, NEAR_SHARE * scene.length_mm)
    depth = np.full(_SIDE_PX * _SIDE_PX, np.inf)
    depth[fragments.pixel.numpy()] = fragments.depth.numpy()
    return depth.reshape(_SIDE_PX, _SIDE_PX)
