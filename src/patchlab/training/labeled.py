"""Write a folder of labeled renders for `harden`: `python -m patchlab.training.labeled --out DIR`.

In: seeds, and objects: the procedural ones, or scene files. Out: PNGs and labels.csv. A procedural object gets
another shape, view, light, camera and background in every render, drawn like the built-in networks' training pictures
but from seeds that they have not seen. A scene's bare object is rendered in its views.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from patchlab.harden.labeled_photos import write_labels
from patchlab.training.fit import class_names
from patchlab.training.pictures import HELD_OUT_SEED, randomize_materials, render_mesh
from patchproof.base.color import codes_from_srgb
from patchproof.base.output import check_folder, make_folder
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import read_toml, validate_model
from patchproof.mesh import primitives
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.scene.scene import build_scene

DEFAULT_SEED = 2 * HELD_OUT_SEED  # the built-in networks' accuracy was measured on smaller seeds


def main() -> None:
    """Render objects and write the folder."""
    parser = argparse.ArgumentParser(description="Write labeled renders of objects.")
    parser.add_argument("--out", type=Path, required=True, help="a new folder")
    parser.add_argument("--each", type=int, default=18, help="renders of each object")
    parser.add_argument("--size-px", type=int, default=96, help="their side")
    parser.add_argument("--seed", type=int, default=DEFAULT_SEED, help="of procedural objects at least 1000000")
    parser.add_argument("--scenes", type=Path, nargs="*", help="scene files in place of the procedural objects")
    options = parser.parse_args()
    common = options.each, options.size_px, options.seed
    renders = render_scenes(options.scenes, *common) if options.scenes else render_procedural(*common)
    print(f"{write_labeled(options.out, renders)} renders in {options.out}")


def render_procedural(each: int, size_px: int, seed: int) -> Iterator[tuple[str, Tensor]]:
    """Yield (label, uint8 3×S×S) of `each` shapes of every object that the built-in networks know."""
    for number, (label, name) in enumerate(zip(class_names(), primitives.primitive_names(), strict=True)):
        for i in range(each):
            rng = np.random.default_rng([seed, number, i])
            yield label, render_mesh(randomize_materials(primitives.build(name, seed + i), rng), 1, rng, size_px)[0][0]


def render_scenes(files: list[Path], each: int, size_px: int, seed: int) -> Iterator[tuple[str, Tensor]]:
    """Yield (label, uint8 3×S×S) of `each` views of every scene's bare object."""
    for file in files:
        settings = validate_model(SceneSettings, read_toml(file), str(file))
        scene = build_scene(settings, file.resolve().parent, seed)
        stage = set_stage(scene)
        for i in range(each):
            with torch.no_grad():
                render = photograph(stage, None, scene.draw("evaluate", 1, seed, i), (size_px, size_px))
            yield str(settings.target.label), codes_from_srgb(render)[0]


def write_labeled(out: Path, renders: Iterator[tuple[str, Tensor]]) -> int:
    """Write renders and labels.csv into a new folder; returns their number."""
    check_folder(out, ())
    make_folder(out)
    rows = []
    for number, (label, picture) in enumerate(renders):
        rows.append((f"{number:05d}.png", label))
        Image.fromarray(picture.permute(1, 2, 0).numpy()).save(out / rows[-1][0])
    write_labels(rows, out)
    return len(rows)


if __name__ == "__main__":
    main()
