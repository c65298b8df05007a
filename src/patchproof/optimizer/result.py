"""What a run is for, as files: a patch's `design.png`, or a texture's `object.glb`, `texture_*.png` and `mask.png`.

In: a problem and its best design's pixels; or a scene and its run's folder. Out: files that replace earlier ones only
when complete; or the pixels again, to the bit. `mask.png` shows the masks of all textures one below the other, white
where a texture was free to change.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from patchproof.optimizer.problem import Problem
from patchproof.optimizer.texture import Texture
from patchproof.output import write_whole
from patchproof.scene.export import write_glb
from patchproof.scene.scene import Scene
from patchproof.strict import Refused

_DESIGN, _OBJECT, _MASK = "design.png", "object.glb", "mask.png"
RESULT_FILES = (_DESIGN, _OBJECT, "texture_*.png", _MASK)


def save_result(problem: Problem, design: np.ndarray, folder: Path) -> None:
    """Write the design, or the object with its new textures."""
    if not isinstance(problem.subject, Texture):
        _write_png(folder / _DESIGN, design)
        return
    canvas, textures = problem.scene.canvas, problem.subject.surface.textures(design)
    write_whole(folder / _OBJECT, lambda path: write_glb(canvas.mesh, textures, path))
    for i, texture in enumerate(textures):
        _write_png(folder / f"texture_{i}.png", texture)
    width = max(mask.shape[1] for mask in canvas.mask)
    masks = [np.pad(mask, ((0, 0), (0, width - mask.shape[1]))) for mask in canvas.mask]
    _write_png(folder / _MASK, np.concatenate(masks).astype(np.uint8) * 255)


def read_result(scene: Scene, folder: Path) -> np.ndarray:
    """The design's pixels of a finished run; of a texture run 1×M×3."""
    if scene.piece is not None:
        return _read_png(folder / _DESIGN)
    textures = [_read_png(folder / f"texture_{i}.png") for i in range(len(scene.canvas.mask))]
    for texture, mask in zip(textures, scene.canvas.mask, strict=True):
        if texture.shape[:2] != mask.shape:
            raise Refused(
                "the textures of this scene", f"{texture.shape[1]} × {texture.shape[0]} pixels", "optimize again"
            )
    return Texture(scene, torch.device("cpu")).surface.texels(textures)


def _write_png(path: Path, pixels: np.ndarray) -> None:
    write_whole(path, lambda part: Image.fromarray(pixels).save(part, "PNG"))


def _read_png(path: Path) -> np.ndarray:
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB"))
