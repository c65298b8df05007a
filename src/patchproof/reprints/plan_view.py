"""Draw where the piece goes on the object: a picture of the object's side, and distances to its edges.

In: a scene with a mesh and its piece. Out: a `PlacementPicture` for the sheet's last page, with millimeters to the
object's edges. The picture is rendered from a distance of 60 times the object's length, at which perspective moves
nothing by more than 1 % of the object's depth.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import photo_codes_from_srgb, srgb_from_linear
from patchproof.base.geometry import rect_border, rect_corners
from patchproof.base.settings import BackgroundSettings
from patchproof.channel.effects import Light, Pose
from patchproof.render.photograph import shade
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import relight, render_views
from patchproof.scene.backgrounds import load_backgrounds
from patchproof.scene.conditions import Conditions
from patchproof.scene.mesh_scene import require_mesh
from patchproof.scene.patch_scene import PatchScene
from patchproof.scene.placement import SurfaceFrame, patch_frame
from patchproof.sheets.plan_page import PlacementPicture
from patchproof.sheets.template import Template

DISTANCE_LENGTHS = 60.0  # of the camera, over the object's length
PICTURE_PX = 600  # along the longer side
MARGIN_FACTOR = 1.06  # of the object's extent


def draw_plan_view(scene: PatchScene, template: Template) -> PlacementPicture:
    """Draw the object as seen from the piece's side, with the piece's outline and, in tiles, its seams."""
    # cameras may count their angles from another side
    scene = replace(scene, frame=patch_frame(scene.mesh, scene.settings.patch))
    frame, placement = scene.frame, scene.placement
    axes = np.stack([frame.right, -frame.up])  # millimeters right and down, from the middle of the object

    def project(points: np.ndarray) -> np.ndarray:  # to the picture's plane
        return np.asarray(points) @ axes.T

    low, high = project(scene.mesh.vertices).min(0), project(scene.mesh.vertices).max(0)
    outline = project(placement.world(rect_border((0, 0, *placement.size_mm), 16)))  # bent paper has bent edges
    half = np.maximum(np.abs([low, high, outline.min(0), outline.max(0)]).max(0) * MARGIN_FACTOR, 1.0)
    seams, names = [], []
    tiles = []
    if template.tiles is not None:
        from patchproof.sheets.tiles import plan_tiles

        tiles = plan_tiles(template, scene.piece)
    for tile in tiles:
        corners = project(placement.world(rect_corners(tile.part_mm)))
        seams += [(tuple(corners[1]), tuple(corners[2])), (tuple(corners[2]), tuple(corners[3]))]
        names.append((tuple(corners.mean(0)), tile.name))
    return PlacementPicture(
        picture=plan_picture(set_stage(scene), scene.frame, half),
        picture_mm=(-half[0], -half[1], 2 * half[0], 2 * half[1]),
        object_mm=(*low, *(high - low)),
        outline_mm=tuple(map(tuple, outline)),
        seams_mm=tuple(seams),
        names_mm=tuple(names),
    )


def plan_picture(
    stage: Stage, frame: SurfaceFrame, half_mm: np.ndarray, side_px: int = PICTURE_PX, colors: np.ndarray | None = None
) -> np.ndarray:
    """Render a stage's object in even light on white, seen along a frame's normal, spanning ± half_mm: uint8 H×W×3.

    `colors` (uint8 h×w×3) are laid over the scene's piece, and shown without light.
    """
    scene = require_mesh(stage.scene)
    distance = DISTANCE_LENGTHS * scene.length_mm
    px_per_mm = side_px / (2 * half_mm.max())
    width, height = (int(v) for v in np.maximum(np.rint(2 * half_mm * px_per_mm), 16))
    fov = float(np.degrees(2 * np.arctan(half_mm.min() / distance)))
    view = {"fov_deg": fov, "look_at": "object"}
    settings = scene.settings.changed(view=view, camera={"photo_px": (width, height), "file": None})
    white = load_backgrounds(BackgroundSettings(color=(1.0, 1.0, 1.0)), Path())
    plain = replace(stage, scene=replace(scene, settings=settings, frame=frame, backgrounds=white, camera=None))
    piece = None if colors is None else PiecePicture.of(torch.tensor(colors, dtype=torch.float32) / 255)
    with torch.no_grad():
        views = render_views(plain, piece, _frontal_conditions(distance, 0.55, 0.45), (width, height))
        light = _pixel_rows(shade(views, None))
        if piece is not None:
            covered = views.on_piece.pixel[views.on_piece.share[:, 0] > 0]
            if len(covered):
                ambient = _frontal_conditions(distance, 1.0, 0.0)
                light[covered] = _pixel_rows(shade(relight(views, ambient), piece))[covered]
    picture = srgb_from_linear(light.clamp(0, 1)).reshape(height, width, 3).cpu().numpy()
    return photo_codes_from_srgb(picture)


def _pixel_rows(pictures: Tensor) -> Tensor:
    """Reshape 1×3×H×W to H·W × 3."""
    return pictures[0].permute(1, 2, 0).reshape(-1, 3)


def _frontal_conditions(distance_mm: float, ambient: float, directional: float) -> Conditions:
    """Conditions of one frontal view in ambient light and directional light from the upper left."""
    direction = {"light_azimuth_deg": np.array([-30.0]), "light_elevation_deg": np.array([45.0])}
    light = Light(ambient=np.array([ambient]), directional=np.array([directional]), **direction)
    return Conditions(pose=Pose(distance_mm=np.array([distance_mm])), light=light)
