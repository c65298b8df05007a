"""Images by class for 2D patches: photographs named in a CSV, or renders of an object without photographs.

In: a folder with its CSV, scenes with meshes, settings of pasting. Out: the classes and their scenes; a folder of
PNGs with `labels.csv`, as a scene of images reads them. The bare object is rendered over its scene's backgrounds from
training views, in training light and without camera effects, which the scene of images adds itself; light beyond sRGB
white is clipped. These views are never among those that measure designs in 3D.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import torch
from pydantic import Field, model_validator

from patchlab.harden.labeled_photos import write_labels
from patchlab.study.grid import CellValues, scene_of
from patchproof.base.color import srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.input import is_file
from patchproof.base.settings import (
    BackgroundSettings,
    CameraSettings,
    ObjectSettings,
    OptimizeSettings,
    PatchSettings,
    PrinterSettings,
    SceneSettings,
    TargetSettings,
    ViewSettings,
)
from patchproof.base.validation import Positive, PositiveRange, Range, Share, StrictModel, expand_path
from patchproof.classifier.network import Classifier
from patchproof.optimizer.responses import in_chunks
from patchproof.optimizer.subject import as_pixels
from patchproof.render.photograph import shade
from patchproof.render.stage import Stage, set_stage
from patchproof.render.views import render_views
from patchproof.report.page import png
from patchproof.scene.image_scene import ImageScene, build, largest_share, read_labels
from patchproof.scene.interface import SceneSource
from patchproof.sheets.piece import Piece

_RENDER_PX = 384


class PastedSettings(StrictModel):
    """Images by class, and how a patch is pasted into them."""

    images: str | None = None  # a folder of images
    labels: str | None = None  # CSV: file name, label
    renders: tuple[str, ...] = ()  # scenes with meshes; each adds a class, its target's
    renders_each: Annotated[int, Field(ge=2)] = 64  # renders of each scene
    made_px: Annotated[int, Field(ge=8, le=512)] = 60  # the patch's side in texels
    shown_px: Positive = 30.0  # and in pixels of the network's own size
    scale: PositiveRange = (0.8, 1.25)  # random factor of shown_px
    roll_deg: Range = (-22.5, 22.5)  # as in Brown et al.'s published program
    erasing: Share = 0.5  # chance of Random Erasing in training
    printer: PrinterSettings = PrinterSettings()  # as in a scene
    camera: CameraSettings = CameraSettings()  # as in a scene
    optimize: OptimizeSettings = OptimizeSettings()  # as in a scene

    @model_validator(mode="after")
    def _has_images(self):
        if (self.images is None) != (self.labels is None):
            raise ValueError("takes images and labels together")
        if self.images is None and not self.renders:
            raise ValueError("takes images and labels, or renders, or both")
        return self


@dataclass(frozen=True)
class ImageClass:
    """Images of one class: photographs named in a CSV, or renders of an object's scene."""

    label: str | int
    accept: tuple[str | int, ...] = ()
    scene: CellValues | None = None  # the scene whose renders they are, if any


def list_classes(images: str | None, table: str | None, scenes: Sequence[CellValues], base: Path) -> list[ImageClass]:
    """All classes with images: a folder's by its CSV of labels, then one per scene to render."""
    classes = []
    if images is not None and table is not None:
        for label in labels_with_images(Path(expand_path(images, base)), Path(expand_path(table, base))):
            classes.append(ImageClass(int(label) if label.isdecimal() else label))
    for values in scenes:
        if values["scene"]["object"]["mesh"] is None:
            do = "name photographs of it in the CSV of labels instead"
            raise Refused("a scene with a mesh to render", values["file"], do)
        target = values["scene"]["target"]
        classes.append(ImageClass(target["label"], tuple(target["accept"]), values))
    return classes


def labels_with_images(folder: Path, table: Path) -> list[str]:
    """The different labels, in lower case, of the images in `folder` that the CSV `table` names."""
    found = list(dict.fromkeys(label for name, label in read_labels(table, folder) if is_file(folder / name)))
    if not found:
        expected = f"the images that {table.name} names in {folder}"
        raise Refused(expected, "a folder that holds none of them", "copy them there")
    return found


def class_scene(
    settings: PastedSettings, base: Path, images_of: ImageClass, classifier: Classifier, seed: int, folder: Path
) -> ImageScene:
    """Build a scene of one class's images, with a patch without frame; writes renders to `folder`."""
    images, table = settings.images or "", settings.labels or ""
    if images_of.scene is not None:
        images, table = _render_class(images_of.label, images_of.scene, base, seed, settings.renders_each, folder)
    scene = build(SceneSource(scene_settings(settings, images_of, classifier, images, table), base, seed))
    side = float(settings.made_px)
    return replace(scene, piece=Piece((side, side), (), 1.0), sheet_id=f"patch2d:{seed}")


def scene_settings(
    settings: PastedSettings, images_of: ImageClass, classifier: Classifier, images: str, table: str
) -> SceneSettings:
    """Scene settings in which a millimeter of the patch is one texel; its size in pictures follows the network's."""
    side = settings.made_px
    low, high = (settings.shown_px * factor / classifier.input_px for factor in settings.scale)
    largest = largest_share(settings.roll_deg)
    if high > largest:
        most, got = largest * classifier.input_px, f"shown_px = {settings.shown_px:g} times {settings.scale[1]:g}"
        expected = f"a patch of at most {most:.0f} pixels before a network of {classifier.input_px}"
        raise Refused(expected, got, "show it smaller")
    return SceneSettings(
        object=ObjectSettings(images=images, labels=table),
        patch=PatchSettings(width_mm=side, height_mm=side),
        target=TargetSettings(label=images_of.label, accept=images_of.accept, models=(classifier.name,)),
        view=ViewSettings(patch_share=(low, high), roll_deg=settings.roll_deg),
        background=BackgroundSettings(erasing=settings.erasing),
        printer=settings.printer,
        camera=settings.camera,
        optimize=settings.optimize,
    )


def _render_class(label: str | int, values: CellValues, base: Path, seed: int, n: int, folder: Path) -> tuple[str, str]:
    subfolder = folder / str(len(list(folder.iterdir())))
    subfolder.mkdir()
    names = write_renders(set_stage(scene_of(base, values | {"seed": seed})), n, _RENDER_PX, subfolder)
    return str(subfolder), str(write_labels([(name, label) for name in names], subfolder))


def write_renders(stage: Stage, n: int, side_px: int, folder: Path) -> list[str]:
    """Write n square renders of the stage's bare object as PNGs; returns their names in `folder`."""
    names = []
    for part in in_chunks(stage.scene.draw("train", n)):
        with torch.no_grad():
            light = shade(render_views(stage, None, part, (side_px, side_px)), None)
        for picture in srgb_from_linear(light.clamp(0, 1)):
            names.append(f"{stage.scene.sheet_id}_{len(names):04d}.png")
            (folder / names[-1]).write_bytes(png(as_pixels(picture)))
    return names
