"""Render the training pictures of the built-in networks: procedural objects.

In: seeds. Out: pictures, labels and boxes. Our renderer shows objects with drawn shapes, colors, textures, poses,
lights, cameras and backgrounds. Half of the pictures are rendered at the network's size, as in
training a patch, half at twice the size and then downscaled, as a photograph is.
Left out on purpose: real photographs. The networks serve demos and tests; their accuracy on real objects is unknown.
"""

import dataclasses
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from patchproof.base.color import codes_from_srgb
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import validate_model
from patchproof.classifier.network import center_square
from patchproof.mesh import primitives
from patchproof.mesh.mesh import Mesh
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.scene import patterns
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.placement import view_frame

LENGTH_MM = 300.0
VIEWS_PER_SHAPE = 10
HELD_OUT_SEED = 1_000_000  # training uses smaller seeds only


class Pictures(NamedTuple):
    """uint8 N×3×S×S, each picture's label N, and its object's box N×4 as shares of the side."""

    images: Tensor
    labels: Tensor
    boxes: Tensor


def render_pictures(per_class: int, seed: int, size_px: int) -> Pictures:
    """Render every class, each shape under VIEWS_PER_SHAPE drawn conditions."""
    images, labels, boxes = [], [], []
    for label, name in enumerate(primitives.primitive_names()):
        for shape in range(-(-per_class // VIEWS_PER_SHAPE)):
            rng = np.random.default_rng([seed, label, shape])
            mesh = randomize_materials(primitives.build(name, seed + shape), rng)
            shape_images, shape_boxes = render_mesh(mesh, VIEWS_PER_SHAPE, rng, size_px)
            images.append(shape_images)
            boxes.append(shape_boxes)
            labels += [label] * VIEWS_PER_SHAPE
    return Pictures(torch.cat(images), torch.tensor(labels), torch.cat(boxes))


def load_or_render(folder: Path, per_class: int, seed: int, size_px: int) -> Pictures:
    """Render pictures, or load them from the folder if an earlier call, by any version of the code, stored them."""
    from safetensors.torch import load_file, save_file

    file = folder / f"{per_class}_{seed}_{size_px}.safetensors"
    if file.is_file():
        return Pictures(**load_file(file))
    rendered = render_pictures(per_class, seed, size_px)
    folder.mkdir(parents=True, exist_ok=True)
    save_file(rendered._asdict(), file)
    return rendered


def shrink_pictures(pictures: Pictures, size_px: int) -> Pictures:
    """Downscale pictures to `size_px`; labels and boxes stay."""
    parts = pictures.images.split(1024)
    small = [codes_from_srgb(center_square(part.float() / 255, size_px)) for part in parts]
    return pictures._replace(images=torch.cat(small))


def render_mesh(mesh: Mesh, count: int, rng: np.random.Generator, size_px: int) -> tuple[Tensor, Tensor]:
    """Render `count` uint8 pictures and boxes of a mesh scaled to LENGTH_MM; half of them directly at `size_px`."""
    scale = LENGTH_MM / np.ptp(mesh.vertices, axis=0).max()
    mesh = dataclasses.replace(mesh, vertices=mesh.vertices * scale)
    backgrounds = Backgrounds(tuple(patterns.background(rng) for _ in range(count)))
    settings = _draw_settings(rng, 2 * size_px)
    frame, seed = view_frame(mesh, settings), settings.optimize.seed
    scene = MeshScene(settings, Path(), seed, "", mesh, frame, backgrounds, notes=mesh.warnings)
    stage, conditions = set_stage(scene), scene.draw("evaluate", count, int(rng.integers(1 << 30)))
    half = count // 2
    renders = [center_square(photograph(stage, None, conditions[half:], (2 * size_px, 2 * size_px)), size_px)]
    if half:
        renders.insert(0, photograph(stage, None, conditions[:half], (size_px, size_px)))
    return codes_from_srgb(torch.cat(renders)), torch.as_tensor(scene.boxes(conditions), dtype=torch.float32)


def _draw_settings(rng: np.random.Generator, photo_px: int) -> SceneSettings:
    """Draw a scene's ranges for one shape, which fills a quarter to nine tenths of the picture, from all around."""
    fov_deg = rng.uniform(25, 65)
    share = np.exp(rng.uniform(np.log(0.3), np.log(0.85)))
    distance = LENGTH_MM / (2 * np.tan(np.radians(fov_deg) / 2) * share)
    nearest = max(0.85 * distance, 1.05 * LENGTH_MM)  # any nearer, the camera could be inside the object
    return validate_model(
        SceneSettings,
        {
            "object": {"mesh": "primitive:mug", "length_mm": LENGTH_MM},
            "patch": {"width_mm": 10, "height_mm": 10, "side": str(rng.choice(["+x", "-x", "+z", "-z"]))},
            "target": {"label": 0, "models": ["builtin"]},
            "view": {
                "azimuth_deg": [-180, 180],
                "elevation_deg": [-10, 60],
                "roll_deg": [-10, 10],
                "distance_mm": [nearest, max(1.2 * distance, nearest)],
                "fov_deg": fov_deg,
                "look_at_jitter": 0.1,
            },
            "light": {"ambient": [0.2, 0.8], "directional": [0.1, 0.9]},
            "camera": {
                "photo_px": [photo_px, photo_px],
                "exposure_ev": [-0.8, 0.6],
                "white_balance": 0.15,
                "blur_px": [0, 1.5],
                "noise": [0, 0.04],
                "jpeg": [40, 95],
            },
        },
        "the training recipe",
    )


def randomize_materials(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with its own colors (in half of the cases), worn ones, or drawn colors and textures."""
    kind = rng.choice(["own", "worn", "mixed", "drawn"], p=[0.5, 0.2, 0.2, 0.1])
    materials = []
    for material in mesh.materials:
        if kind == "worn":
            worn = np.clip(0.8 + 0.25 * (patterns.texture(rng).mean(2, keepdims=True) - 0.5), 0, 1).repeat(3, 2)
            material = dataclasses.replace(material, texture_srgb=codes_from_srgb(worn))
        if kind == "drawn" or (kind == "mixed" and rng.random() < 0.4):
            plain = rng.random() < 0.4
            color = tuple(rng.uniform(0.02, 0.9, 3)) if plain else (1.0, 1.0, 1.0)
            drawn = None if plain else codes_from_srgb(patterns.texture(rng))
            material = dataclasses.replace(material, base_color_linear=color, texture_srgb=drawn)
        materials.append(material)
    return dataclasses.replace(mesh, materials=tuple(materials))


def augment(
    images: Tensor, boxes: Tensor, cards: Tensor, rng: np.random.Generator, pasted: float, widest: float = 1.1
) -> tuple[Tensor, Tensor]:
    """Augment uint8 pictures, as floats in [0, 1], and their boxes: mirror, shift, scale (up to `widest` of a picture
    shows), tint, and paste cards onto a share `pasted`.
    """
    n, size_px = len(images), images.shape[-1]
    x = images.float() / 255
    side = rng.uniform(0.75, widest, n)
    shift = rng.uniform(-1, 1, (2, n)) * np.maximum(1 - side, 0.05)
    matrix = np.zeros((n, 2, 3), np.float32)
    matrix[:, 0, 0], matrix[:, 1, 1] = side * rng.choice([-1, 1], n), side
    matrix[:, :, 2] = shift.T
    grid = torch.nn.functional.affine_grid(torch.from_numpy(matrix), list(x.shape), align_corners=False)
    x = torch.nn.functional.grid_sample(x, grid, padding_mode="border", align_corners=False)
    boxes = _transform_boxes(boxes, torch.from_numpy(matrix))
    gain = torch.from_numpy(np.exp(rng.normal(0, [[0.25], [0.07], [0.07], [0.07]], (4, n))).astype(np.float32))
    x = (x - 0.45) * gain[0, :, None, None, None] + 0.45
    offset = torch.from_numpy(rng.normal(0, 0.05, (n, 1, 1, 1)).astype(np.float32))
    x = (x * gain[1:].T[:, :, None, None] + offset).clamp(0, 1)
    for i in np.flatnonzero(rng.random(n) < pasted):
        height, width = (int(v) for v in (rng.integers(12, 44, 2) * size_px) // 96)
        top, left = int(rng.integers(0, size_px - height)), int(rng.integers(0, size_px - width))
        card = cards[int(rng.integers(len(cards)))][None]
        small = torch.nn.functional.interpolate(card, (height, width), mode="bilinear", antialias=True)[0]
        x[i, :, top : top + height, left : left + width] = small * float(rng.uniform(0.4, 1.0))
    return x, boxes


def _transform_boxes(boxes: Tensor, matrix: Tensor) -> Tensor:
    """Transform boxes N×4 with pictures that were sampled by matrices N×2×3 on [-1, 1]; clipped to the picture."""
    scale = torch.stack([matrix[:, 0, 0], matrix[:, 1, 1]], 1)[:, None]
    corners = ((2 * boxes - 1).view(-1, 2, 2) - matrix[:, None, :, 2]) / scale
    return torch.cat([corners.amin(1), corners.amax(1)], 1).add(1).div(2).clamp(0, 1)
