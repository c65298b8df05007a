"""`preview`: show a scene as a page before anything is optimized, in seconds.

In: a scene file. Out: a folder with `preview.html`, a self-contained page without requests. If the piece is refused,
the page shows the object without it and the reason. A piece whose place is still to be searched is shown in the middle
of the side that azimuth 0 faces. Left out on purpose: anything that depends on a design, which `plan` shows; layouts of
texture coordinates to draw masks on, which 3D programs such as Blender export.
"""

import html
import warnings as python_warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from patchproof.app.begin.guess import lying_hint, other_axis
from patchproof.app.begin.sides import SIDE_NAMES, sample_views, side_of, side_views, turntable
from patchproof.base.errors import Refused
from patchproof.base.output import base64_uri, image_bytes, new_folder, write_atomically
from patchproof.base.settings import SceneSettings, load_scene_settings
from patchproof.base.text import short_repr
from patchproof.channel.printer import identity_printer
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.optimizer.patch import Patch
from patchproof.render.stage import set_stage
from patchproof.report.page import data_uri, jpeg, png, render_page
from patchproof.scene.interface import Scene, fit_text, measurable_text, require_piece
from patchproof.scene.mesh_scene import MeshScene
from patchproof.scene.patch_scene import PatchScene, UnplacedScene
from patchproof.scene.placement import gap_limit_mm
from patchproof.scene.scene import build_scene
from patchproof.scene.texture_scene import TextureScene

PAGE = "preview.html"
_FIRST_DEG = 30  # to the right of the front: shown before the slider is moved


@dataclass(frozen=True)
class Preview:
    """The page's path, lines for the terminal, warnings, and refusals in a sentence (None: nothing was refused)."""

    page: Path
    lines: tuple[str, ...]
    warnings: tuple[str, ...]
    refused: str | None
    __repr__ = short_repr

    def _repr_html_(self) -> str:
        page = html.escape(self.page.read_text(encoding="utf-8"))
        return f'<iframe srcdoc="{page}" style="width:100%;height:600px;border:0"></iframe>'


def preview(scene: str | Path | Scene, out: str | Path, *, overwrite: bool = False) -> Preview:
    """Write the preview of a scene, or of a scene file, into the folder `out`; a notebook shows the page.

    Raises:
        Refused: for files that cannot be read, and networks that cannot be used.
    """
    path = Path("scene") if isinstance(scene, Scene) else Path(scene)
    settings = scene.settings if isinstance(scene, Scene) else load_scene_settings(path)
    with new_folder(out, (PAGE,), overwrite, (scene,)) as folder:
        scene, refused = (scene, None) if isinstance(scene, Scene) else _scene(settings, path.resolve().parent)
        with python_warnings.catch_warnings(action="always", record=True) as said:
            classifiers = [load_classifier(net, scene.base) for net in scene.networks]
        indices, unknown = _indices(settings, [classifier.labels for classifier in classifiers])
        stage = set_stage(scene)
        views = sample_views(stage, classifiers, indices)
        warnings = (*scene.warnings, *_up_warning(scene, settings), *(str(each.message) for each in said))
        sides, scale, turns = {}, {}, []
        if isinstance(scene, MeshScene):
            sides, scale = side_views(stage)
            for azimuth_deg, picture in turntable(stage).items():
                webp = image_bytes(picture, "WEBP", {"quality": 80})  # 3 to 10 kB: as JPEG it would be twice as large
                turns.append((azimuth_deg, picture.shape[:2], base64_uri(webp, "image/webp")))
        facts, summaries = _facts(scene, settings), _answers(settings, views)
        unprintable = _unprintable(scene, max(classifier.input_px for classifier in classifiers))
        problems = [text for text in (refused, unknown, unprintable) if text]
        text = render_page(
            "preview.html.j2",
            name=path.name,
            target=settings.target,
            facts=facts,
            problems=problems,
            warnings=warnings,
            sides=[(side, SIDE_NAMES[side], data_uri(png(picture))) for side, picture in sides.items()],
            scale=scale,
            holder=side_of(scene.placement.normal) if isinstance(scene, PatchScene) else None,
            gap_limit_mm=gap_limit_mm(scene.placement.size_mm) if isinstance(scene, PatchScene) else None,
            turns=turns,
            first_deg=_FIRST_DEG,
            looks=[(look, data_uri(jpeg(look["picture"]))) for look in views],
            summaries=summaries,
        )
        write_atomically(folder / PAGE, text)
    lines = (*(f"{name}: {text}" for name, text in facts), *summaries)
    return Preview(Path(out) / PAGE, lines, warnings, " ".join(problems) or None)


def _up_warning(scene: Scene, settings: SceneSettings) -> tuple[str, ...]:
    """Warn of an object that would stand better with its file's other axis up."""
    up, name = settings.object.up, settings.object.mesh or ""
    if not isinstance(scene, MeshScene) or ":" in name or (doubt := lying_hint(scene.mesh.vertices, up)) is None:
        return ()
    return (f'the object may lie: {doubt}. If it does, write up = "{other_axis(up)}" in [object]',)


def _unprintable(scene: Scene, network_px: int) -> str | None:
    """The refusal of a piece that `optimize` would refuse for its size."""
    try:
        if scene.HAS_PIECE and scene.HAS_PLACE:
            piece_scene = require_piece(scene)
            Patch(piece_scene, identity_printer(), piece_scene.design_px(network_px), torch.device("cpu"))
    except Refused as refused:
        return str(refused)
    return None


def _scene(settings: SceneSettings, base: Path) -> tuple[Scene, str | None]:
    """Build the scene; if its piece is refused, the scene without it, and the refusal."""
    try:
        scene = build_scene(settings, base)
    except Refused as refused:
        if settings.object.mesh is None or settings.patch.kind != "patch":
            raise
        patch = {"place": "auto", "at_mm": None, "offset_mm": (0.0, 0.0), "spin_deg": 0.0}
        view = {"look_at": "object", "front": "patch"}
        return build_scene(settings.changed(patch=patch, view=view), base), str(refused)
    if not isinstance(scene, UnplacedScene):
        return scene, None
    try:
        placed_scene = scene.with_piece_at(settings.patch.side, 0.0)
    except Refused:  # the piece does not fit there; the search may find another place
        return scene, None
    return (scene if placed_scene.placement.warnings else placed_scene), None


def _indices(settings: SceneSettings, labels: Sequence[Sequence[str]]) -> tuple[list[tuple[int, ...]], str | None]:
    """Find the target in each network's labels: its indices, empty if it is unknown there, and the last refusal."""
    target, indices, unknown = settings.target, [], None
    for network_labels in labels:
        try:
            indices.append(find_labels(network_labels, target.label, target.accept))
        except Refused as refused:
            indices.append(())
            unknown = str(refused)
    return indices, unknown


def _facts(scene: Scene, settings: SceneSettings) -> list[tuple[str, str]]:
    """Describe object, camera, piece, markers and place, as (name, sentence)."""
    facts = [("object", scene.description())]
    if isinstance(scene, MeshScene):
        width, height, depth = np.ptp(scene.mesh.vertices, axis=0)
        size = f"{width:.0f} × {height:.0f} × {depth:.0f} mm (width, height and depth of its front)"
        front, view = side_of(scene.frame.normal), scene.settings.view
        (left, right), (low, high), (near, far) = view.azimuth_deg, view.elevation_deg, view.distance_mm
        around = f"{left:g}° to {right:g}° about the {SIDE_NAMES[front]} ({front}), {low:g}° to {high:g}° above it"
        facts = [("object", f"{size}, {len(scene.mesh.faces)} faces")]
        facts.append(("camera", f"{around}, {near:g} to {far:g} mm away"))
    placement = scene.placement_summary()
    size = "{:g} × {:g} mm".format(*placement["size_mm"])
    if isinstance(scene, PatchScene):
        side = side_of(scene.placement.normal)
        lies = f"{placement['family']}, {size}, facing {SIDE_NAMES[side]} ({side})"
        facts.append(("piece", f"{lies}: {fit_text(placement)}"))
        readable = measurable_text(scene.unreadable_share, scene.placement.family)
        facts.append(("markers", f"{scene.piece.marker_mm:.1f} mm, {readable}" if scene.piece.markers else "none"))
    else:
        facts.append(("piece", "not placed" if isinstance(scene, UnplacedScene) else f"{size}: {placement['reason']}"))
    if isinstance(scene, TextureScene):
        for name, mask in zip(scene.canvas.names, scene.canvas.mask, strict=True):
            if mask.any():
                texels = f"{mask.shape[1]} × {mask.shape[0]} texels, of which {mask.mean():.0%} may change"
                facts.append(("texture", f'"{name}", {texels}'))
    if settings.patch.place == "auto":
        side = settings.patch.side
        note = f"; until then it is tried on the {SIDE_NAMES[side]} ({side})" if isinstance(scene, PatchScene) else ""
        facts.append(("place", f'"auto": optimize searches the object for it{note}'))
    return facts


def _answers(settings: SceneSettings, views: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say how often each network recognizes the bare object, and its most frequent label."""
    lines = []
    for answers in zip(*(view["answers"] for view in views), strict=True):
        ((most, times),) = Counter(answer["labels"][0][0] for answer in answers).most_common(1)
        count = sum(answer["recognized"] for answer in answers)
        lines.append(
            f'{answers[0]["network"]}: "{settings.target.label}" first in {count} of {len(views)} views of the bare '
            f'object; most often "{most}" ({times})'
        )
    return lines
