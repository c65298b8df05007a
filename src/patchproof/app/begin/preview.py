"""`preview`: show a scene as a page before anything is optimized, in seconds.

In: a scene file. Out: a folder with `preview.html`, a self-contained page without requests: the object from its six
sides (those of `patch.side`; front and back are along z, as in glTF's standard and after `object.up = "z"` turned the y
of other programs there), the piece colored by its gap, and sample views with the networks' answers. If the piece is
refused, the page shows the object without it and the reason. A piece whose place is still to be searched is shown in
the middle of the side that azimuth 0 faces. Left out on purpose: anything that depends on a design, which `plan` shows;
layouts of texture coordinates to draw masks on, which 3D programs such as Blender export.
"""

import html
import math
import warnings as python_warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from torch import Tensor

from patchproof.app.begin.guess import SIDE_NAMES, lying_hint, other_axis
from patchproof.base.errors import Refused
from patchproof.base.geometry import rect_border
from patchproof.base.output import data_uri, new_folder, write_atomically
from patchproof.base.settings import SceneSettings, load_scene_settings
from patchproof.base.text import short_repr
from patchproof.base.validation import Side
from patchproof.channel.printer import identity_printer
from patchproof.classifier.labels import find_labels, refuse_different_entries
from patchproof.classifier.load import load_classifier
from patchproof.classifier.network import Classifier
from patchproof.optimizer.patch import Patch
from patchproof.optimizer.subject import as_pixels
from patchproof.render.photograph import photograph, plan_picture
from patchproof.render.stage import Stage, set_stage
from patchproof.report.page import jpeg, png, render_page
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import PieceScene, Scene, fit_text, measurable_text, require_piece
from patchproof.scene.mesh_scene import MeshScene, require_mesh
from patchproof.scene.patch_scene import PatchScene, UnplacedScene
from patchproof.scene.placement import Placement, gap_limit_mm, side_frame
from patchproof.scene.scene import build_scene
from patchproof.scene.texture_scene import TextureScene

PAGE = "preview.html"
PICTURE_PX = 320  # along the longer side
_ROOM = 1.12  # of the largest extent
_BAR_SHARE = 0.35  # of the picture's width at most
# five colors of viridis, legible to the color-blind; and a color for no surface that is none of them
RAMP_RGB = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))
NO_SURFACE_RGB = (230, 0, 90)
_VIEWS, _TOP = 8, 5
_LEAST_PX = 200  # of a view's side: people see little in smaller ones
_EDGE_POINTS = 8  # bent paper has bent edges


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
        sides, scale = side_views(stage) if isinstance(scene, MeshScene) else ({}, {})
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
    return (f'the object may be lying on its side: {doubt}. If it is, write up = "{other_axis(up)}" in [object]',)


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
    try:
        refuse_different_entries([each for each, found in zip(labels, indices, strict=True) if found], target.label)
    except Refused as refused:
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
            f'{answers[0]["network"]}: "{settings.target.label}" recognized in {count} of {len(views)} views of the '
            f'bare object; most often "{most}" ({times})'
        )
    return lines


def side_views(stage: Stage) -> tuple[dict[Side, np.ndarray], dict[str, float]]:
    """Render a stage's object straight from all six sides, front first, the piece colored by its gap: uint8 squares of
    `PICTURE_PX`; and their scale: a bar of `bar_mm` is `bar_px` long, the ground of upright views is at `ground_px`.
    """
    scene = require_mesh(stage.scene)
    piece_mm = [scene.placement.vertices_mm] if isinstance(scene, PatchScene) else []  # it may overhang
    half_mm = _ROOM * float(np.abs(np.concatenate([scene.mesh.vertices, *piece_mm])).max())
    bar_mm, px_per_mm, pictures = round_length(2 * half_mm * _BAR_SHARE), PICTURE_PX / (2 * half_mm), {}
    for side in SIDE_NAMES:
        frame, colors = side_frame(scene.mesh, side), None
        if isinstance(scene, PatchScene) and (scene.placement.normals @ frame.normal).max() > 1e-6:
            colors = gap_colors(scene.placement)
        pictures[side] = plan_picture(stage, frame, np.array([half_mm, half_mm]), PICTURE_PX, colors)
    ground_px = PICTURE_PX / 2 - float(scene.mesh.vertices[:, 1].min()) * px_per_mm
    return pictures, {"bar_mm": bar_mm, "bar_px": bar_mm * px_per_mm, "ground_px": ground_px}


def side_of(direction: np.ndarray) -> Side:
    """The side whose normal is nearest to a direction of the world."""
    axis = int(np.abs(direction).argmax())
    return get_args(Side)[2 * axis + int(direction[axis] < 0)]


def round_length(most_mm: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(most_mm))
    return float(power * max(step for step in (1, 2, 5) if step * power <= most_mm * (1 + 1e-9)))


def gap_colors(placement: Placement) -> np.ndarray:
    """Color the piece's gaps, uint8 N×N×3: 0 to `gap_limit_mm` from dark to light, `NO_SURFACE_RGB` off the surface."""
    shares, stops = placement.gaps_mm / gap_limit_mm(placement.size_mm), np.linspace(0, 1, len(RAMP_RGB))
    channels = [np.interp(np.nan_to_num(shares), stops, column) for column in np.array(RAMP_RGB, float).T]
    colors = np.stack(channels, -1).round().astype(np.uint8)
    colors[np.isnan(placement.gaps_mm)] = NO_SURFACE_RGB
    return colors


def sample_views(stage: Stage, classifiers: list[Classifier], indices: list[tuple[int, ...]]) -> list[dict[str, Any]]:
    """Render 8 views of the bare object and classify them; `indices` are the target's in each network (empty: none).

    A view has its `picture` (uint8 S×S×3), the piece's `outline_px` M×2 in it (None if the piece is turned away), the
    camera's place, and `answers`: by network its most likely `labels` with their confidences, and if it `recognized`
    the target.
    """
    network_px = max(classifier.input_px for classifier in classifiers)
    side_px = network_px * math.ceil(_LEAST_PX / network_px)
    conditions = stage.scene.draw("select", _VIEWS)  # in which nothing is erased
    with torch.no_grad():
        pictures = photograph(stage, None, conditions, (side_px, side_px), jpeg=False)
        logits = [classifier.logits(pictures, stage.scene.boxes(conditions)) for classifier in classifiers]
    places = {name: getattr(conditions.pose, name) for name in ("azimuth_deg", "elevation_deg", "distance_mm")}
    return [
        {
            "picture": as_pixels(pictures[i]),
            "outline_px": _outline(stage, conditions[[i]], side_px),
            **{name: float(values[i]) for name, values in places.items()},
            "answers": [_answer(*each) for each in zip(classifiers, [row[i] for row in logits], indices, strict=True)],
        }
        for i in range(_VIEWS)
    ]


def _answer(classifier: Classifier, logits: Tensor, target: tuple[int, ...]) -> dict[str, Any]:
    best = classifier.probabilities(logits[None])[0].topk(min(_TOP, len(classifier.labels)))
    labels = [(classifier.labels[index], share) for share, index in zip(*map(Tensor.tolist, best), strict=True)]
    recognized = bool(target) and bool(classifier.recognized(logits[None], target)[0])
    return {"network": Path(classifier.name).name, "labels": labels, "recognized": recognized}


def _outline(stage: Stage, conditions: Conditions, side_px: int) -> np.ndarray | None:
    """The piece's cut line in pixels of the photograph's centered square; None if it is turned away."""
    scene = stage.scene
    if not isinstance(scene, PieceScene) or not scene.facing(conditions)[0]:
        return None
    border, photo_px = rect_border((0, 0, *scene.piece.size_mm), _EDGE_POINTS), np.array(scene.photo_px)
    points = (scene.piece_px(conditions, border) - (photo_px - photo_px.min()) / 2) * side_px / photo_px.min()
    return points if np.isfinite(points).all() else None
