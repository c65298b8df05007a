"""Images by class for 2D patches: photographs named in a CSV, or renders of an object where none exist.

In: a folder with its CSV, scenes with meshes. Out: the classes; a folder of PNGs with `labels.csv`, as a scene of
images reads them. The bare object is rendered over its scene's backgrounds from training views, in training light and
without camera effects, which the scene of images adds itself; light beyond sRGB white is clipped. Views that anything
is measured on in 3D are never among them.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from patchproof.color import srgb_from_linear
from patchproof.optimizer.pixels import as_pixels
from patchproof.render.photograph import shade
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import see
from patchproof.scene.image_scene import labels_of
from patchproof.scene.scene import build_scene
from patchproof.settings import load_scene_settings
from patchproof.strict import Refused, expand

_CHUNK, _RENDER_PX = 16, 384


@dataclass(frozen=True)
class ImageClass:
    """Images of one class: photographs named in a CSV, or renders of a scene's object."""

    label: str | int
    accept: tuple[str | int, ...]
    scene: str | None  # of which they are renders


def classes_of(images: str | None, table: str | None, scenes: tuple[str, ...], base: Path) -> list[ImageClass]:
    """Every class that there are images of: a folder's by its CSV of labels, then one per scene to render."""
    found = []
    if table is not None:
        for label in labels_of(Path(expand(images, base)), Path(expand(table, base))):
            found.append(ImageClass(int(label) if label.isdecimal() else label, (), None))
    for name in scenes:
        scene = load_scene_settings(expand(name, base))
        if scene.object.mesh is None:
            raise Refused("a scene with a mesh to render", name, "name photographs of it in the CSV of labels instead")
        found.append(ImageClass(scene.target.label, scene.target.accept, name))
    return found


def render_class(one: ImageClass, base: Path, seed: int, n: int, folder: Path) -> tuple[str, str]:
    """Write n renders and their labels into a new folder in `folder`; the paths of both."""
    path = Path(expand(one.scene, base))
    scene = build_scene(load_scene_settings(path), path.resolve().parent, seed)
    own = folder / str(len(list(folder.iterdir())))
    own.mkdir()
    names = write_renders(set_stage(scene), n, _RENDER_PX, own)
    return str(own), str(write_labels([(name, one.label) for name in names], own))


def write_renders(stage: Stage, n: int, side_px: int, folder: Path) -> list[str]:
    """Write n square renders of the stage's bare object as PNGs; their names in `folder`."""
    from PIL import Image

    conditions, names = stage.scene.draw("train", n), []
    for first in range(0, n, _CHUNK):
        with torch.no_grad():
            light = shade(see(stage, None, conditions[first : first + _CHUNK], (side_px, side_px)), None)
        for picture in srgb_from_linear(light.clamp(0, 1)):
            names.append(f"{stage.scene.sheet_id}_{len(names):04d}.png")
            Image.fromarray(np.ascontiguousarray(as_pixels(picture))).save(folder / names[-1])
    return names


def write_labels(rows: list[tuple[str, str | int]], folder: Path) -> Path:
    """Write `labels.csv` of (file name, label) into `folder`."""
    path = folder / "labels.csv"
    with path.open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([("file", "label"), *rows])
    return path
