"""`new`: write a commented scene file for a mesh, photographs of an object, or images.

In: a mesh (a file, or `primitive:NAME`), a folder of photographs with a blank sheet's manifest in or beside it, or a
folder of images with a CSV of labels. Out: a TOML file that loads, and lines that say what was guessed. Camera
distances follow the object's length; the piece is the largest that fits on one of its sides. A file that could not be
optimized is never written.
"""

import json
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from patchproof.app.begin import guess
from patchproof.app.begin.guess import SIDE_NAMES, UpAxis, guess_label, other_axis
from patchproof.base.errors import Refused
from patchproof.base.input import is_file, is_folder
from patchproof.base.output import check_file, write_atomically
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import NETWORK_FILE, validate_model
from patchproof.classifier.imagenet import has_imagenet
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.primitives import longest_mm
from patchproof.scene.candidate_places import PlaceFinder
from patchproof.scene.image_scene import read_labels
from patchproof.scene.patch_scene import UnplacedScene
from patchproof.scene.scene import build_scene
from patchproof.sheets.manifest import load_manifest

NEAR, FAR = 1.5, 2.7  # camera distances over the object's length: those of a default scene of 300 mm
_HEAD = ("# Written by patchproof new. All keys and their ranges: patchproof keys.", "# Millimeters and degrees.", "")


def new_scene(
    thing: str,
    out: str | Path,
    *,
    label: str | None = None,
    length_mm: float | None = None,
    up: UpAxis | None = None,
    models: Sequence[str] | None = None,
    overwrite: bool = False,
) -> list[str]:
    """Write the scene file `out` for a mesh or a folder; returns lines with guesses and warnings. `length_mm` and `up`
    replace the file's. Default `models`: `builtin` for a primitive, else `imagenet` if installed.
    """
    out = Path(out)
    if models is None:  # the built-in network knows primitives and nothing else
        models = ("builtin",) if thing.startswith("primitive:") or not has_imagenet() else ("imagenet",)
    check_file(out, overwrite, (thing,))
    base = out.resolve().parent
    if thing.startswith("primitive:") or not is_folder(Path(thing)):
        text, lines = _mesh_scene(thing, base, label, length_mm, up, models)
    elif length_mm is not None or up is not None:
        do = "leave it out: pictures have no length and no axes"
        raise Refused("a mesh with --length-mm or --up", f"the folder {thing}", do)
    else:
        text, lines = _folder_scene(Path(thing), base, label, models)
    scene = build_scene(validate_model(SceneSettings, tomllib.loads(text), "the new scene"), base)
    if isinstance(scene, UnplacedScene):
        next(PlaceFinder(scene).places())  # refuses an object without any place for the piece
    write_atomically(out, text)
    return [*lines, *(f"warning: {warning}" for warning in scene.warnings)]


def _mesh_scene(
    thing: str, base: Path, label: str | None, length_mm: float | None, axis: UpAxis | None, models
) -> tuple[str, list[str]]:
    """The scene file's text for a mesh, and lines with the guesses."""
    target = guess_label(_labels(models, base), label, thing)
    path, primitive, source = Path(thing), thing.startswith("primitive:"), "as given"
    stated = ("y", "primitives are", None) if primitive else (axis, source, None) if axis else None
    up, reason, doubt = stated or guess.guess_up(path)
    if length_mm is None:
        source = "the primitive's own" if primitive else "by the file's units, meters: measure it"
        length_mm = longest_mm(thing.partition(":")[2]) if primitive else guess.guess_length_mm(path)
    piece = guess.guess_piece(load_mesh(thing, length_mm, up), length_mm)
    near, far = (float(f"{times * length_mm:.2g}") for times in (NEAR, FAR))
    azimuth, elevation = "of the camera about the vertical; 0 faces the piece", "above the horizontal"
    if piece.side == "+y":
        azimuth, elevation = "of the camera to left and right of straight above", "from there toward the back"
    bend_comment = "paper follows the surface" if piece.bend else "a flat card lies close enough"
    other_up = _line(f'# up = "{other_axis(up)}"', f"in its place if the preview shows it lying on its side: {doubt}")
    again = f"write the scene again with --up {other_axis(up)}: sides and sizes change with it"
    text = "\n".join(
        [
            *_HEAD,
            "[object]",
            f"mesh = {_quoted(thing if primitive else _path(path, base))}",
            _line(f"length_mm = {length_mm:g}", f"its longest extent, {source}"),
            _line(f'up = "{up}"', f"the file's axis that points up: {reason}"),
            *([] if doubt is None else [other_up, f"# Best of all {again}."]),
            "",
            "[patch]",
            *_size(*piece.size_mm),
            _line(f'side = "{piece.side}"', f'{SIDE_NAMES[piece.side]}; place = "auto" searches the whole object')
            if piece.side
            else _line('place = "auto"', "no side's middle takes it: optimize searches the whole object"),
            *([] if piece.side else [_line('side = "+z"', "front: what azimuth 0 faces")]),
            _line(f"bend = {str(piece.bend).lower()}", bend_comment),
            "",
            *_target(target, models, base),
            "",
            "[view]",
            _line(f"distance_mm = [{near:g}, {far:g}]", f"to the object's middle: {NEAR} to {FAR} times its length"),
            _line("azimuth_deg = [-60, 60]", azimuth),
            _line("elevation_deg = [2, 27]", elevation),
            "",
            "# [background]",
            _line('# images = "places"', "a folder of photographs of places; synthetic rooms without"),
            "",
        ]
    )
    width, height = piece.size_mm
    lying = f"; {doubt}: if the preview shows it lying on its side, {again}" if doubt else ""
    place = f"on its {SIDE_NAMES[piece.side]} ({piece.side})" if piece.side else "wherever the search finds"
    return text, [
        f'up: "{up}", {reason}{lying}',
        f"length: {length_mm:g} mm, {source}",
        f"piece: {width:g} × {height:g} mm, {'bent, ' if piece.bend else ''}{place}",
        f'label: "{target}" ({models[0]})',
    ]


def _folder_scene(folder: Path, base: Path, label: str | None, models) -> tuple[str, list[str]]:
    """The scene file's text for a folder of photographs or images, and lines with the guesses."""
    tables = sorted(folder.glob("*.csv"))
    files = sorted([*folder.glob("*.json"), *folder.resolve().parent.glob("*.json")])
    manifests = [path for path in files if _is_blank_sheet(path)]
    if not tables and not manifests:
        expected = "a CSV of labels among images, or a blank sheet's JSON in or beside the folder of photographs"
        raise Refused(expected, f"neither for {folder}", "put one there, or name a mesh")
    if not tables and len(manifests) > 1:
        do = "keep the JSON of the blank on the object there, and move the others elsewhere"
        raise Refused("one blank sheet's JSON", ", ".join(path.name for path in manifests), do)
    if not tables:
        target = guess_label(_labels(models, base), label, folder.resolve().name)
        sheet = _line(f"sheet = {_quoted(_path(manifests[0], base))}", "of the blank on the object there")
        lines = ["[object]", f"photos = {_quoted(_path(folder, base))}", sheet, "", _line("[patch]", "as the blank's")]
        text = "\n".join([*_HEAD, *lines, "", *_target(target, models, base), ""])
        source = f"photographs: {folder}, with the blank of {manifests[0].name}"
        return text, [source, f'label: "{target}" ({models[0]})']
    table = next((path for path in tables if path.stem == "labels"), tables[0])
    counts = Counter(words for name, words in read_labels(table, folder) if is_file(folder / name))
    if not counts:
        raise Refused(f"images that {table.name} names in {folder}", "none", "write their file names there")
    network_labels, words = _labels(models, base), label or counts.most_common(1)[0][0]
    if words.isdigit() and int(words) < len(network_labels):
        words = network_labels[int(words)]
    target = guess_label(network_labels, words, folder.name)
    if str(index := find_labels(network_labels, target)[0]) in counts:
        target = index  # as the table has it, by which images are chosen
    lines = ["[object]", f"images = {_quoted(_path(folder, base))}", f"labels = {_quoted(_path(table, base))}", ""]
    lines += ["[patch]", *_size(100, 100), "", *_target(target, models, base), "", "[view]"]
    lines += [_line("patch_share = [0.2, 0.3]", "the piece's longer side over the picture's shorter one"), ""]
    text = "\n".join([*_HEAD, *lines])
    return text, [f"images: {folder}, labels of {table.name}", f'label: "{target}" ({models[0]})']


def _is_blank_sheet(path: Path) -> bool:
    """Check whether a JSON file is the manifest of a blank sheet."""
    try:
        return load_manifest(path).kind == "blank"
    except Refused:
        return False


def _labels(models: Sequence[str], base: Path) -> tuple[str, ...]:
    """The labels of the first network."""
    if not models:
        raise Refused("a network", "none", "leave --models out, or name one")
    return load_classifier(_model(models[0], base), base).labels


def _target(label: str | int, models: Sequence[str], base: Path) -> list[str]:
    names = [_model(name, base) for name in models]
    for name in names[1:]:
        find_labels(load_classifier(name, base).labels, label)
    value = label if isinstance(label, int) else _quoted(label)
    return [
        "[target]",
        _line(f"label = {value}", "an index, or a name in the network's list"),
        f"models = [{', '.join(map(_quoted, names))}]",
        _line('goal = "assist"', '"deceive" measures robustness'),
    ]


def _size(width_mm: float, height_mm: float) -> list[str]:
    return [_line(f"width_mm = {width_mm:g}", "of the piece that is cut out"), f"height_mm = {height_mm:g}"]


def _line(setting: str, comment: str) -> str:
    return f"{setting:<29} # {comment}"


def _model(name: str, base: Path) -> str:
    """A network's name with its path relative to the scene's folder `base`, not to the working directory."""
    match = NETWORK_FILE.fullmatch(name)
    return f"{match[1]}{_path(Path(match[2]), base)}" if match and "${" not in match[2] else name


def _path(path: Path, base: Path) -> str:
    """A path relative to the scene's folder if it lies in there, else absolute."""
    path = path.resolve()
    return (path.relative_to(base) if path.is_relative_to(base) else path).as_posix()


def _quoted(text: str) -> str:
    """A TOML string; JSON's escapes are TOML's."""
    return json.dumps(text, ensure_ascii=False)
