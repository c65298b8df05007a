"""Files of a search for a place: `place.json`, and `place.png` to look at.

In: a `Place` and the scene with the piece there. Out: both files, and the place read back. The picture shows the object
from four directions across the scene's azimuths, each place as a small square from yellow (the best) to purple (the
worst), the drafted ones with their rank, and the chosen piece's outline at its size; a legend says so.
"""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from patchproof.base import geometry
from patchproof.base.color import photo_codes_from_srgb, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, read_json
from patchproof.base.output import write_atomically
from patchproof.base.settings import BackgroundSettings
from patchproof.base.validation import validate_model
from patchproof.channel.effects import Light, Pose
from patchproof.optimizer.place_search import Candidate, Place
from patchproof.render.photograph import shade
from patchproof.render.raster import rasterize
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import cameras, near_mm, render_views
from patchproof.scene.backgrounds import load_backgrounds
from patchproof.scene.conditions import Conditions
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import patch_frame, side_frame, spun_axes
from patchproof.scene.unplaced_scene import UnplacedScene

_RECORD_FILE, _PICTURE_FILE = "place.json", "place.png"
_DIRECTIONS, _SIDE_PX = 4, 420
_LEGEND_PX = 30  # height of the legend
_MARGIN = 1.05  # times the object's diagonal
_SQUARE_SHARE = 0.3  # a square's side, of the piece's
_IN_FRONT_MM = 2.0  # a square's middle at most this deep behind the surface is visible
_COLORS = np.array([(253, 231, 37), (33, 145, 140), (68, 1, 84)], float)  # of viridis, legible to the color-blind
_CHOSEN_COLOR = (230, 0, 90)


def save_place(place: Place, scene: PatchScene, folder: Path) -> None:
    """Write both files; `scene` has the piece at the place."""
    write_atomically(folder / _RECORD_FILE, place.model_dump_json(indent=1) + "\n")
    picture = _picture(place, scene)
    write_atomically(folder / _PICTURE_FILE, lambda path: picture.save(path, "PNG"))


def read_place(folder: Path, scene: UnplacedScene | None = None) -> Place | None:
    """The place in a run's folder; None if there is none, refused if it was searched in another `scene`."""
    path = folder / _RECORD_FILE
    if not is_file(path):
        return None
    record = read_json(path, "the record of a search", "start in another folder")
    place = validate_model(Place, record, str(path))
    if scene is not None and place.sheet_id != scene.sheet_id:
        do = "resume with the same scene file and seed, or start in another folder"
        got = f"a place of sheet {place.sheet_id} in {folder}, not {scene.sheet_id}"
        raise Refused("the place of this scene and seed", got, do)
    return place


def _picture(place: Place, scene: PatchScene) -> Image.Image:
    scene, conditions = _even_scene(scene)
    stage, size, poses = set_stage(scene), (_SIDE_PX, _SIDE_PX), scene.camera_from_world(conditions)
    with torch.no_grad():
        light = shade(render_views(stage, None, conditions, size), None)
    pictures = photo_codes_from_srgb(srgb_from_linear(light.clamp(0, 1)).permute(0, 2, 3, 1).numpy())
    panels = []
    for pose, picture in zip(poses, pictures, strict=True):
        panel, depth = Image.fromarray(picture), _depth(stage, scene, pose)
        draw = ImageDraw.Draw(panel)
        for rank, candidate, corners in _squares(place, scene):
            if _is_visible(scene, pose, depth, corners):
                color = _color(rank / max(len(place.candidates) - 1, 1))
                quad = geometry.project(scene.matrix_px(size), pose, corners)
                draw.polygon([*map(tuple, quad)], color, (0, 0, 0))
                if candidate.draft is not None:
                    x, y = quad.mean(0)
                    font, white = ImageFont.load_default(18), (255, 255, 255)
                    draw.text((x, y), f"{rank + 1}", (0, 0, 0), font, "mm", stroke_width=2, stroke_fill=white)
        border = geometry.rect_border((0, 0, *scene.placement.size_mm), 16)  # bent paper has bent edges
        outline = scene.placement.world(np.concatenate([border, border[:1]]))
        if scene.placement.normal @ (geometry.camera_centers(pose[None])[0] - scene.placement.center_mm) > 0:
            draw.line([*map(tuple, geometry.project(scene.matrix_px(size), pose, outline))], _CHOSEN_COLOR, 4, "curve")
        panels.append(np.asarray(panel))
    picture = Image.fromarray(np.pad(np.concatenate(panels, 1), [(0, _LEGEND_PX), (0, 0), (0, 0)], constant_values=255))
    draw, x = ImageDraw.Draw(picture), _LEGEND_PX // 2
    count, drafted = len(place.candidates), sum(candidate.draft is not None for candidate in place.candidates)
    entries = [(_color(0), f"best of {count} places"), (_color(0.5), "middle"), (_color(1), "worst")]
    entries += [(None, f"1 to {drafted}: drafted, by rank")] if drafted else []
    for color, words in [*entries, (_CHOSEN_COLOR, "outline: the piece where it goes")]:
        if color is not None:
            draw.rectangle((x, _SIDE_PX + 8, x + _LEGEND_PX - 16, _SIDE_PX + _LEGEND_PX - 8), color, (0, 0, 0))
        at, font = (x + _LEGEND_PX, _SIDE_PX + _LEGEND_PX / 2), ImageFont.load_default(14)
        draw.text(at, words, (0, 0, 0), font, "lm")
        x = int(at[0] + font.getlength(words)) + _LEGEND_PX
    return picture


def _even_scene(scene: PatchScene) -> tuple[PatchScene, Conditions]:
    """The scene in even light on white, zoomed to the whole object, and the directions it is seen from."""
    view = scene.settings.view
    distance = sum(view.distance_mm) / 2
    half = float(np.linalg.norm(np.ptp(scene.mesh.vertices, axis=0))) / 2 * _MARGIN
    fov = float(np.degrees(2 * np.arctan(half / distance)))
    settings = scene.settings.changed(view={"fov_deg": fov}, camera={"photo_px": (_SIDE_PX, _SIDE_PX), "file": None})
    white = load_backgrounds(BackgroundSettings(color=(1.0, 1.0, 1.0)), Path())
    (low, high), ones = view.azimuth_deg, np.ones(_DIRECTIONS)
    pose = Pose(
        azimuth_deg=low + (high - low) * (np.arange(_DIRECTIONS) + 0.5) / _DIRECTIONS,
        elevation_deg=ones * sum(view.elevation_deg) / 2,
        distance_mm=ones * distance,
    )
    light = Light(ambient=ones * 0.55, directional=ones * 0.45, light_elevation_deg=ones * 45)
    return replace(scene, settings=settings, backgrounds=white, camera=None), Conditions(pose=pose, light=light)


def _squares(place: Place, scene: PatchScene) -> Iterator[tuple[int, Candidate, np.ndarray]]:
    """(rank from 0, candidate, 4×3 corners of its small square in the world), the worst first."""
    half_mm, patch = _SQUARE_SHARE / 2 * min(scene.placement.size_mm), scene.settings.patch
    for rank, candidate in reversed([*enumerate(place.candidates)]):
        at = candidate.at
        frame = side_frame(scene.mesh, at) if isinstance(at, str) else patch_frame(scene.mesh, patch.changed(at_mm=at))
        right, up = spun_axes(frame, candidate.spin_deg)
        signs = np.array([(-1, 1), (1, 1), (1, -1), (-1, -1)])
        yield rank, candidate, frame.origin_mm + half_mm * signs @ np.stack([right, up])


def _is_visible(scene: PatchScene, pose: np.ndarray, depth: np.ndarray, corners: np.ndarray) -> bool:
    """True if the middle of a square faces the camera and nothing is in front of it."""
    middle, normal = corners.mean(0), np.cross(corners[0] - corners[1], corners[2] - corners[1])
    if normal @ (geometry.camera_centers(pose[None])[0] - middle) <= 0:
        return False
    x, y = np.floor(geometry.project(scene.matrix_px(depth.shape[::-1]), pose, middle[None])[0]).astype(int)
    inside = 0 <= x < depth.shape[1] and 0 <= y < depth.shape[0]
    return inside and bool((pose[:3] @ [*middle, 1])[2] < depth[y, x] + _IN_FRONT_MM)


def _depth(stage: Stage, scene: PatchScene, pose: np.ndarray) -> np.ndarray:
    """H×W distances of the object from the camera along its axis, infinite beside the object."""
    surface, size = stage.object_surface, (_SIDE_PX, _SIDE_PX)
    frames = cameras(pose[None], scene.matrix_px(size)[None], size, stage)
    fragments = rasterize(surface.vertices, surface.faces, frames, near_mm(scene))
    depth = np.full(_SIDE_PX * _SIDE_PX, np.inf)
    depth[fragments.pixel.numpy()] = fragments.depth.numpy()
    return depth.reshape(_SIDE_PX, _SIDE_PX)


def _color(share: float) -> tuple[int, int, int]:
    """Yellow at 0, purple at 1."""
    red, green, blue = (round(float(np.interp(share, (0, 0.5, 1), column))) for column in _COLORS.T)
    return red, green, blue
