"""Inputs that are made to do harm: to run code, to read, write, delete or send what they should not, or to never end.

`KINDS` has for each kind a function of (place, number) that writes the input of that number into `place.given` and
returns what uses it, as a verb would. `guard.attempt` runs it.
"""

from __future__ import annotations

import copy
import io
import json
import os
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from fuzz.guard import Place
from fuzz.hostile_bytes import Rng, broken_json, changed, tweaked
from fuzz.pdf_bombs import PDF_BOMBS
from fuzz.readers import (
    CAMERA,
    CARD,
    CORNERS,
    broken_message,
    corners_coco,
    finished_run,
    honest_photo,
    manifests,
    node,
    onnx_model,
    protobuf,
    small_problem,
    stored_tensor,
    verified,
)

Use = Callable[[], object]
Item = TypeVar("Item")
ENDLESS = ("/dev/zero", "/proc/self/pagemap", "fifo", "sparse", "itself", "missing")
HUGE = [10**4000, -(10**400), 2**63, 1e300, -1e300, 5e-324, "1" * 5000, [[]] * 1000, {"a": {"b": {}}}]
NAMES = (
    "${EMPTY}module:evil.make",
    "mod${EMPTY}ule:evil.make",
    "module${COLON}evil.make",
    "module:evil.make",
    "timm:hf-hub:someone/x-${SECRET}",
    "timm:hf-hub:someone/x",
    "timm:${OUTSIDE}/x",
    "file:../outside/net.onnx",
    "file:${OUTSIDE}/secret.txt",
    "file:/etc/passwd.onnx",
    "clip:ViT-B-32@../outside/secret.txt",
    "torchvision:resnet18@../outside/secret.safetensors",
    "python:evil",
)
PATHS = ("../outside/secret.txt", "${OUTSIDE}/secret.txt", "/etc/passwd", "../../../../../../etc/passwd", "x" * 300)


def of(number: int, items: Sequence[Item]) -> Item:
    """An item for the input's number."""
    return items[number % len(items)]


def endless(path: Path, kind: str) -> Path:
    """Put a file without end, or none, at that path."""
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "sparse":
        with path.open("wb") as file:
            file.truncate(1 << 40)
    else:
        path.symlink_to({"itself": path.name, "missing": "nowhere"}.get(kind, kind))
    return path


def deep(levels: int) -> Any:
    value: Any = 1
    for _ in range(levels):
        value = [value]
    return value


def huge_json(rng: Rng, value: Any) -> bytes:
    """The value with a number, text or list in it that is far too large."""
    value = copy.deepcopy(value)
    places: list[tuple[Any, Any]] = []

    def walk(part: Any) -> None:
        items = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
        for key, item in items:
            places.append((part, key))
            walk(item)

    walk(value)
    table, key = places[rng.integers(len(places))]
    text = json.dumps(tweaked(rng, value))
    odd = [*HUGE, deep(500)][rng.integers(len(HUGE) + 1)]
    if isinstance(odd, int):  # Python writes no more than 4,300 digits
        table[key] = "@"
        return json.dumps(value).encode().replace(b'"@"', str(odd)[:4300].encode())
    table[key] = odd
    return (json.dumps(value) if rng.random() < 0.9 else text).encode()


def png(width: int, height: int, stored_rows: int = 0) -> bytes:
    """A gray PNG that says its size, with so many rows in it (0: all)."""

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    packer, row = zlib.compressobj(9), bytes(1 + width)
    data = b"".join(packer.compress(row) for _ in range(stored_rows or height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


PICTURES: tuple[Callable[[], bytes], ...] = (
    lambda: png(12_000, 9_900),
    lambda: png(60_000, 60_000, 50),
    lambda: png(119_000_000, 1, 1),
    lambda: png(1, 100_000),
    lambda: png(20_000, 5_000, 10),
    lambda: b"GIF89a" + b"\xff" * 20,
)


# --- sheets ---


def sheet_with(changes: Callable[[dict], None], place: Place) -> Path:
    from patchproof.classifier.builtin import load_builtin

    manifest, label = copy.deepcopy(manifests()[0]), load_builtin().labels[0]
    manifest["promise"]["target"] |= {"label": label, "indices": [0]}
    manifest["promise"]["models"][0] |= {"name": "builtin", "sha256": None}
    manifest["settings"]["target"] |= {"label": label, "models": ["builtin"]}
    changes(manifest)
    (place.given / "sheet.json").write_text(json.dumps(manifest))
    photos = place.given / "photos"
    photos.mkdir(exist_ok=True)
    (photos / "a.jpg").write_bytes(honest_photo())
    return place.given / "sheet.json"


def use_sheet(place: Place, number: int = 0) -> Use:
    import patchproof as pp

    return lambda: pp.verify(place.given / "photos", place.given / "sheet.json", place.out / "report")


def sheet_names(place: Place, number: int) -> Use:
    name = of(number, NAMES)

    def change(manifest: dict) -> None:
        for model in manifest["promise"]["models"]:
            model |= {"name": name, "sha256": None}
        manifest["settings"]["target"]["models"] = [name]

    sheet_with(change, place)
    return use_sheet(place)


def sheet_paths(place: Place, number: int) -> Use:
    def change(manifest: dict) -> None:
        table = of(number // len(PATHS), ("printer", "object", "camera", "background"))
        key = {"printer": "profile", "object": "mesh", "camera": "calibration", "background": "images"}[table]
        manifest["settings"].setdefault(table, {})[key] = of(number, PATHS) + (".npz" if table == "printer" else "")

    sheet_with(change, place)
    return use_sheet(place)


def sheet_values(place: Place, number: int) -> Use:
    from patchproof.sheets.manifest import load_manifest

    (place.given / "sheet.json").write_bytes(huge_json(np.random.default_rng(number), manifests()[number % 2]))
    return lambda: verified(place.out, load_manifest(place.given / "sheet.json"))


def sheet_files(place: Place, number: int) -> Use:
    """What is no file, in place of a sheet."""
    import patchproof as pp

    endless(place.given / "sheet.json", of(number, ENDLESS))
    return lambda: pp.load_manifest(place.given / "sheet.json")


def pdf(place: Place, number: int) -> Use:
    from patchproof.sheets.pdf_raster import attached_manifests, page_count, rasterize_page

    names = list(PDF_BOMBS)
    path = place.given / "sheet.pdf"
    path.write_bytes(PDF_BOMBS[of(number, names)]())
    return of(
        number // len(names),
        [lambda: rasterize_page(path), lambda: (attached_manifests(path), page_count(path))],
    )


def pdf_files(place: Place, number: int) -> Use:
    from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

    path = endless(place.given / "sheet.pdf", of(number, ENDLESS))
    return of(number // len(ENDLESS), [lambda: rasterize_page(path), lambda: attached_manifests(path)])


# --- runs ---


def received_run(place: Place) -> Path:
    import shutil

    shutil.copytree(finished_run(), place.given / "run")
    shutil.copy(finished_run().parent / "scene.toml", place.given)
    return place.given / "run"


def run_names(place: Place, number: int) -> Use:
    """A run whose networks are code, or lie elsewhere."""
    import patchproof as pp

    run = received_run(place)
    details = json.loads((run / "run.json").read_text())
    details["settings"]["target"]["models"] = [of(number, NAMES)]
    (run / "run.json").write_text(json.dumps(details))

    def use() -> None:
        import shutil

        shutil.copytree(run, place.out / "run")  # evaluate writes into it
        shutil.copy(place.given / "evil.py", place.out)
        pp.evaluate(place.out / "run", n=2)

    return use


def run_values(place: Place, number: int) -> Use:
    import patchproof as pp

    run, rng = received_run(place), np.random.default_rng(number)
    details = json.loads((run / "run.json").read_text())
    (run / "run.json").write_bytes(huge_json(rng, details) if number % 2 else broken_json(rng, details))

    def use() -> None:
        loaded = pp.load_run(run)
        loaded._repr_html_()
        pp.sheet(loaded, place.out / "sheet.pdf")

    return use


def run_pictures(place: Place, number: int) -> Use:
    """A run whose design is a bomb, or no file."""
    import patchproof as pp

    run = received_run(place)
    (run / "design.png").unlink()
    if number % 2:
        (run / "design.png").write_bytes(of(number // 2, PICTURES)())
    else:
        endless(run / "design.png", of(number // 2, ENDLESS))
    return lambda: pp.sheet(pp.load_run(run), place.out / "sheet.pdf")


def checkpoint(place: Place, number: int) -> Use:
    from patchproof.base.output import CHECKPOINT_FILE
    from patchproof.optimizer.loop import load_checkpoint

    path = place.given / CHECKPOINT_FILE
    head = json.dumps({"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}}).encode()
    contents = [
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 1 << 30) + b"{" * 1000,
        struct.pack("<Q", len(head)) + head,
        struct.pack("<Q", 200_000) + b"[" * 200_000,
    ]
    if number % 2:
        path.write_bytes(of(number // 2, contents))
    else:
        endless(path, of(number // 2, ENDLESS))
    problem = small_problem()
    return lambda: load_checkpoint(place.given, problem)


def resumed_log(place: Place, number: int) -> Use:
    """A run to be resumed whose log is endless or a single line."""
    import shutil

    import patchproof as pp

    shutil.copytree(finished_run(), place.out / "run", ignore=shutil.ignore_patterns("run.json", "steps.jsonl"))
    log, scene = place.out / "run" / "steps.jsonl", scene_beside(place)
    if number % 2:
        log.write_bytes(b"x" * (50 << 20))
    else:
        endless(log, of(number // 2, ("/proc/self/pagemap", "sparse", "itself")))
    return lambda: pp.optimize(scene, place.out / "run", promise=pp.PromiseOptions(views=8, controls=()), resume=True)


def scene_beside(place: Place) -> Path:
    """The scene of the finished run, as somebody sent it."""
    path = place.given / "scene.toml"
    path.write_bytes((finished_run().parent / "scene.toml").read_bytes())
    return path


def journal(place: Place, number: int) -> Use:
    from patchproof.sheets.manifest import Manifest

    path = place.out / "photos.jsonl"
    lines = (
        b"{" * (20 << 20),
        b'{"file":1}\n' * 500_000,
        b'{"a":' * 5000 + b"\n",
        b'{"file": "' + b"1" * (17 << 20) + b'"}',
    )
    if number % 2:
        path.write_bytes(of(number // 2, lines))
    else:
        endless(path, of(number // 2, ("sparse", "itself", "missing")))
    manifest = Manifest.model_validate(manifests()[0])
    return lambda: verified(place.out, manifest, path)


def imported_picture(place: Place, number: int) -> Use:
    import patchproof as pp

    path = place.given / "picture.png"
    if number % 2:
        path.write_bytes(of(number // 2, PICTURES)())
    else:
        endless(path, of(number // 2, ENDLESS))
    scene = scene_beside(place)
    return lambda: pp.import_patch(path, scene, place.out / "run", promise=pp.PromiseOptions(views=8, controls=()))


# --- photographs ---


def photo_links(place: Place, number: int) -> Use:
    """A folder of photographs with pipes, devices, files without end, and names of all kinds."""
    sheet_with(lambda manifest: None, place)
    name = of(number // 6, ("b", "=cmd", "\x1b[2J", "$frac$", "＝1", "${SECRET}"))
    endless(place.given / "photos" / f"{name}.jpg", of(number, ENDLESS))
    return use_sheet(place)


def photo_folders(place: Place, number: int) -> Use:
    """Folders of photographs that are links, also to themselves."""
    sheet_with(lambda manifest: None, place)
    photos = place.given / "photos"
    (photos / "session_a").symlink_to(of(number, (".", "/dev", "session_a", "../photos", "nowhere")))
    (photos / "controls").symlink_to(of(number, ("/proc/self/fd", "..", "controls")))
    return use_sheet(place)


def controls(place: Place, number: int) -> Use:
    import patchproof as pp

    sheet_with(lambda manifest: None, place)
    folder = place.given / "controls" / of(number, ("gray", "mean", "module:evil", "${SECRET}"))
    folder.mkdir(parents=True)
    endless(folder / "a.jpg", of(number, ENDLESS))
    photos, sheet = place.given / "photos", place.given / "sheet.json"
    return lambda: pp.verify(photos, sheet, place.out / "report", controls=place.given / "controls")


def photo_pictures(place: Place, number: int) -> Use:
    sheet_with(lambda manifest: None, place)
    (place.given / "photos" / "b.png").write_bytes(of(number, PICTURES)())
    return use_sheet(place)


def calibrated_photos(place: Place, number: int) -> Use:
    from patchproof.calibrate.camera import find_boards
    from patchproof.photo.read import list_photos
    from patchproof.sheets.blank import load_board

    endless(place.given / "a.jpg", of(number, ENDLESS))
    (place.given / "b.png").write_bytes(of(number, PICTURES)())
    return lambda: (list_photos(place.given), find_boards(place.given, load_board("charuco_a4")))


def blank_photos(place: Place, number: int) -> Use:
    """Photographs of a blank sheet on an object, which a scene is made of."""
    import patchproof as pp

    sheet_with(lambda manifest: manifest.update(kind="blank"), place)
    endless(place.given / "photos" / "b.jpg", of(number, ENDLESS))
    settings = {
        "object": {"photos": "photos", "sheet": "sheet.json"},
        "patch": {},
        "target": {"label": "carton", "models": ["builtin"]},
    }
    return lambda: pp.make_scene(settings, base=place.given)


# --- what a scene names ---


def backgrounds(place: Place, number: int) -> Use:
    from patchproof.base.settings import BackgroundSettings
    from patchproof.scene.backgrounds import load_backgrounds

    folder = place.given / "places"
    folder.mkdir()
    for i in range(of(number, (1, 40, 300))):
        (folder / f"{i:04d}.png").write_bytes(png(400, 300))
    if number % 2:
        (folder / "b.png").write_bytes(of(number // 2, PICTURES)())
    else:
        endless(folder / "b.png", of(number // 2, ENDLESS))

    def use() -> None:
        loaded = load_backgrounds(BackgroundSettings(images="places"), place.given)
        for choice in np.random.default_rng(0).random((100, 5)):
            loaded.picture(choice, (400, 300), (64, 64))

    return use


TOMLS: tuple[Callable[[], str], ...] = (
    lambda: "a = " + "[" * 5000 + "]" * 5000,
    lambda: ".".join(["a"] * 100_000) + " = 1",
    lambda: "\n".join(f"[{'.'.join(['a'] * i)}]" for i in range(1, 1000)),
    lambda: "a = [" + "1," * 400_000 + "]",
    lambda: "a = " + "9" * 5000,
    lambda: "a = 1e999999999",
    lambda: '"' + "\\u0000" * 10_000 + '" = 1',
    lambda: "x" * (2 << 20) + " = 1",
    lambda: "a = '''" + "\n" * 900_000 + "'''",
    lambda: "a = 99999999-99-99",
    lambda: "[object]\nmesh = '../outside/secret.txt'\nlength_mm = 1e300\n[target]\nlabel='a'\nmodels=['builtin']",
    lambda: "[object]\nmesh = 'primitive:carton'\nlength_mm = 1e-300\n[target]\nlabel='carton'\nmodels=['builtin']",
)


def scene_toml(place: Place, number: int) -> Use:
    import patchproof as pp

    path = place.given / "scene.toml"
    if number < len(TOMLS):
        path.write_text(of(number, TOMLS)())
    else:
        endless(path, of(number, ENDLESS))
    return lambda: pp.load_scene(path)


def template(place: Place, number: int) -> Use:
    from patchproof.base.packaged import packaged_path
    from patchproof.sheets.blank import blank_page

    text = packaged_path("print_templates", "blank_a4.toml").read_text(encoding="utf-8")
    numbers = [i for i, letter in enumerate(text) if letter.isdigit() and "=" in text[text.rfind("\n", 0, i) : i]]
    at = numbers[(37 * number) % len(numbers)]
    odd = of(number, ("9" * 400, "1e300", "1e-300", "-1", "nan", "1e5", "0"))
    (place.given / "t.toml").write_text(text[:at] + odd + text[at + 1 :], encoding="utf-8")
    return lambda: blank_page(place.out / "t.pdf", template=str(place.given / "t.toml"))


def printer(place: Place, number: int) -> Use:
    import zipfile

    from patchproof.base.packaged import packaged_path
    from patchproof.channel.printer import load_printer

    head_of = packaged_path("calibration", "printers", "coated.json")
    (place.given / "p.json").write_bytes(head_of.read_bytes())
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        head = b"{'descr': '|u1', 'fortran_order': False, 'shape': (33, 33, 33, 3), }\n"
        for name in of(number, (["lut", "gamut"], ["lut"], ["../../out/lut", "lut", "gamut"], ["lut"] * 2)):
            content = (
                b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + bytes(of(number, (1 << 26, 0, 107_811)))
            )
            archive.writestr(f"{name}.npy", content)
    if number % 3:
        (place.given / "p.npz").write_bytes(buffer.getvalue())
    else:
        endless(place.given / "p.npz", of(number // 3, ENDLESS))
    return lambda: load_printer(str(place.given / "p.npz"))


def camera(place: Place, number: int) -> Use:
    from patchproof.channel.lens import load_camera

    path = place.given / "camera.json"
    if number % 3:
        path.write_bytes(huge_json(np.random.default_rng(number), CAMERA))
    else:
        endless(path, of(number // 3, ENDLESS))

    def use() -> None:
        loaded = load_camera(str(path))
        loaded.pinhole_frame((400, 300))
        loaded.undistort_points(np.array([[10.0, 10.0]]), (400, 300))

    return use


def icc(place: Place, number: int) -> Use:
    from fuzz.readers import profile
    from patchproof.calibrate.icc import bake

    path, data = place.given / "p.icc", bytearray(profile())
    if number % 2:
        data[128:132] = struct.pack(">I", of(number // 2, (2**31, 100, 0, 2**32 - 1)))  # how many tags
        data[:4] = struct.pack(">I", len(data))
        path.write_bytes(data)
    else:
        endless(path, of(number // 2, ENDLESS))
    return lambda: bake(path, "p")


def mask(place: Place, number: int) -> Use:
    from patchproof.scene.texture_scene import _read_faces, _read_mask

    path = place.given / "m.png"
    if number % 2:
        texts = (b"9" * 5000, b"0-" + b"9" * 4000, b"0\n" * 2_000_000, b"-" * 100_000, b"0-11\n" * 100_000)
        path.write_bytes(of(number // 2, texts))
        return lambda: _read_faces(path, 12)
    if number % 4:
        path.write_bytes(of(number // 4, PICTURES)())
    else:
        endless(path, of(number // 4, ENDLESS))
    return lambda: _read_mask(path)


# --- tables ---


def labels(place: Place, number: int) -> Use:
    from patchlab.paper.image_classes import labels_with_images
    from patchproof.scene.image_scene import read_labels

    path = place.given / "labels.csv"
    lines = (
        b"a" * (15 << 20),
        b'"' * (8 << 20),
        b"\n" * (15 << 20),
        b"../outside/secret.txt,a\n",
        b"/etc/passwd,a\n",
        b"a,b\n" * 3_000_000,
    )
    if number % 2:
        path.write_bytes(of(number // 2, lines))
    else:
        endless(path, of(number // 2, ENDLESS))
    read = of(number // 4, [lambda: read_labels(path, path.parent), lambda: labels_with_images(place.given, path)])
    return read


def harden(place: Place, number: int) -> Use:
    """A labeled folder whose table points out of it."""
    from patchlab.harden.harden_study import HardenSettings, harden_images
    from patchproof.classifier.builtin import load_builtin

    label = load_builtin().labels[0]
    pixels = np.random.default_rng(number).integers(0, 256, (64, 64, 3), np.uint8)
    for folder in (place.given, place.outside):
        Image.fromarray(pixels).save(folder / "a.png")
    names = [
        "../outside/a.png",
        str(place.outside / "a.png"),
        "./a.png",
        "a.png\0",
        "../given/a.png",
        "=a.png",
        "${OUTSIDE}/a.png",
    ]
    (place.given / "labels.csv").write_text(f"file,label\n{of(number, names)},{label}\n", encoding="utf-8")
    settings = HardenSettings(
        images=str(place.given),
        labels=str(place.given / "labels.csv"),
        models=("builtin",),
        epsilons=(0.1,),
        steps=1,
        attacks=(),
    )
    return lambda: harden_images(settings, place.out / "hardened")


def boxes(place: Place, number: int) -> Use:
    from patchproof.evidence.annotations import load_boxes

    coco = {
        "images": [{"id": 1, "file_name": "a.jpg", "width": 400, "height": 300}],
        "categories": [{"id": 1, "name": "bright"}],
        "annotations": [{"image_id": 1, "category_id": 1, "bbox": [1, 2, 30, 40]}],
    }
    path, rng = place.given / "boxes.json", np.random.default_rng(number)
    if number % 4 == 0:
        endless(path, of(number // 4, ENDLESS))
    elif number % 4 == 1:
        many = of(number // 4, (200_000, 10_000_000))
        part = b'{"image_id":1,"category_id":1,"bbox":[1,2,3,4]},' * min(many, 1 << 20)
        path.write_bytes(b'{"images":[],"categories":[],"annotations":[' + part + b"{}]}")
    else:
        path.write_bytes(huge_json(rng, coco) if number % 2 else json.dumps(changed(rng, coco)).encode())
    return lambda: load_boxes(path, "bright")


def corners(place: Place, number: int) -> Use:
    from patchproof.evidence.annotations import corners_of_photo, load_corners

    path, rng = place.given / of(number, ("c.csv", "c.json")), np.random.default_rng(number)
    points = (
        "0,0,9,0,9,9,0,9",
        "1e308,-1e308,1e308,1e308,nan,inf,1e999,0",
        "=cmd|' /c'!A1,2,3,4,5,6,7,8",
        "9" * 100_000,
    )
    if number % 4 > 1:
        endless(path, of(number // 4, ENDLESS))
    elif path.suffix == ".json":
        path.write_bytes(huge_json(rng, corners_coco()))
    else:
        head, *_ = CORNERS.splitlines()
        names = ("../outside/secret.txt", "${OUTSIDE}/secret.txt", "a.jpg" * 5000)
        rows = (f"{name},{of(number // 4, points)}\n" for name in names)
        path.write_text(f"{head}\n{''.join(rows) * (1 if number < 16 else 100_000)}")

    def use() -> None:
        named = load_corners(path)
        for name in list(named)[:9]:
            corners_of_photo(named[name], name, place.given / name[:200])

    return use


# --- meshes ---


def glb(tree: Any, binary: bytes = b"", sizes: Sequence[int] = ()) -> bytes:
    text = json.dumps(tree).encode() if not isinstance(tree, bytes) else tree
    text += b" " * (-len(text) % 4)
    first, total = sizes or (len(text), 28 + len(text) + len(binary))
    return (
        b"glTF"
        + struct.pack("<III", 2, total, first)
        + b"JSON"
        + text
        + struct.pack("<I", len(binary))
        + b"BIN\0"
        + binary
    )


def gltf_tree(**changes: Any) -> dict:
    """A triangle."""
    tree: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"byteLength": 48}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 12}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 3, "type": "SCALAR"},
        ],
    }
    return tree | changes


TRIANGLE = np.eye(3, dtype=np.float32).tobytes() + np.arange(3, dtype=np.uint32).tobytes()
ACCESSORS = gltf_tree()["accessors"]
VERTICES = b"element vertex %d\nproperty float x\nproperty float y\nproperty float z\n"


def with_uri(uri: str) -> bytes:
    return json.dumps(gltf_tree(buffers=[{"byteLength": 48, "uri": uri}])).encode()


def with_texture(image: dict) -> bytes:
    material = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    return glb(gltf_tree(materials=[material], textures=[{"source": 0}], images=[image]), TRIANGLE)


MESHES: dict[str, Callable[[], tuple[str, bytes]]] = {
    "count of 2^31": lambda: (
        "glb",
        glb(gltf_tree(accessors=[ACCESSORS[0] | {"count": 2**31}, ACCESSORS[1]]), TRIANGLE),
    ),
    "zeros": lambda: (
        "glb",
        glb(gltf_tree(accessors=[{"componentType": 5126, "count": 10**7, "type": "VEC3"}, ACCESSORS[1]])),
    ),
    "matrices": lambda: (
        "glb",
        glb(gltf_tree(accessors=[{"componentType": 5126, "count": 1.9e7, "type": "MAT4"}, ACCESSORS[1]])),
    ),
    "negative": lambda: ("glb", glb(gltf_tree(accessors=[ACCESSORS[0] | {"count": -3}, ACCESSORS[1]]), TRIANGLE)),
    "chunk": lambda: ("glb", glb(gltf_tree(), TRIANGLE, (2**32 - 1, 2**32 - 1))),
    "deep json": lambda: ("glb", glb(b"[" * 500_000)),
    "circle": lambda: ("glb", glb(gltf_tree(nodes=[{"mesh": 0, "children": [0]}]), TRIANGLE)),
    "long chain": lambda: (
        "glb",
        glb(gltf_tree(nodes=[{"mesh": 0, "children": [i + 1]} for i in range(3000)] + [{}]), TRIANGLE),
    ),
    "doubling": lambda: (
        "glb",
        glb(gltf_tree(nodes=[{"mesh": 0, "children": [i + 1, i + 1]} for i in range(40)] + [{}]), TRIANGLE),
    ),
    "many instances": lambda: (
        "glb",
        glb(gltf_tree(scenes=[{"nodes": list(range(3000))}], nodes=[{"mesh": 0}] * 3000), TRIANGLE),
    ),
    "sparse": lambda: (
        "glb",
        glb(gltf_tree(accessors=[ACCESSORS[0] | {"sparse": {"count": 2**31}}, ACCESSORS[1]]), TRIANGLE),
    ),
    "uri file": lambda: ("gltf", with_uri("../outside/secret.txt")),
    "uri passwd": lambda: ("gltf", with_uri("file:///etc/passwd")),
    "uri network": lambda: ("gltf", with_uri("http://127.0.0.1:9/a.bin")),
    "uri zero": lambda: ("gltf", with_uri("/dev/zero")),
    "uri data": lambda: ("gltf", with_uri("data:application/octet-stream;base64," + "A" * 30_000_000)),
    "uri no data": lambda: ("gltf", with_uri("data:;base64,!!")),
    "texture bomb": lambda: ("glb", with_texture({"uri": "data:image/png;base64," + _base64(png(12_000, 9_900))})),
    "texture file": lambda: ("glb", with_texture({"uri": "../outside/secret.txt"})),
    "texture zero": lambda: ("glb", with_texture({"uri": "/dev/zero"})),
    "obj libraries": lambda: (
        "obj",
        b"mtllib m.obj\nmtllib /dev/zero\nmtllib ../outside/secret.txt\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
    ),
    "obj map": lambda: ("obj", b"mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n"),
    "obj index": lambda: ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 99999999999999999999\nf 1 2 -2147483649\n"),
    "obj polygon": lambda: ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 100_000 + b"\n"),
    "obj materials": lambda: (
        "obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"".join(b"usemtl a%d\nf 1 2 3\n" % i for i in range(3000)),
    ),
    "obj numbers": lambda: ("obj", b"v 0 0 0\nv 1e400 nan " + b"9" * 5000 + b"\nv 0 1 0\nf 1 2 3\n"),
    "obj spaces": lambda: (
        "obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2" + b" " * 2_000_000 + b"3\n" + b"f" + b" \t" * 100_000 + b"\n",
    ),
    "ply count": lambda: (
        "ply",
        _ply(VERTICES % (2**32 - 1)),
    ),
    "ply list": lambda: (
        "ply",
        _ply(VERTICES % 3 + b"element face 1\nproperty list uint int vertex_indices\n")
        + bytes(36)
        + b"\xff\xff\xff\xff",
    ),
    "ply elements": lambda: (
        "ply",
        _ply(b"".join(b"element e%d 1\nproperty list uchar int x\n" % i for i in range(3000))),
    ),
    "stl count": lambda: ("stl", bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(500)),
    "stl text": lambda: ("stl", b"solid a\n" + b"facet normal 0 0 0\n" * 100_000),
}


def _base64(data: bytes) -> str:
    import base64

    return base64.b64encode(data).decode()


def _ply(lines: bytes) -> bytes:
    return b"ply\nformat binary_little_endian 1.0\n" + lines + b"end_header\n"


def mesh(place: Place, number: int) -> Use:
    from patchproof.mesh.load_mesh import load_mesh

    suffix, data = MESHES[of(number, list(MESHES))]()
    (place.given / f"m.{suffix}").write_bytes(data)
    (place.given / "m.mtl").write_text("newmtl a\nmap_Kd ../outside/secret.txt\nmap_Kd /etc/passwd\n" * 2)
    return lambda: load_mesh(place.given / f"m.{suffix}", 100.0)


def mesh_files(place: Place, number: int) -> Use:
    from patchproof.mesh.load_mesh import load_mesh

    if number % 2:
        path = endless(place.given / f"m.{of(number, ('glb', 'obj', 'ply', 'stl'))}", of(number // 2, ENDLESS))
    else:
        endless(place.given / "m.mtl", of(number // 2, ENDLESS))
        path = place.given / "m.obj"
        path.write_bytes(MESHES["obj map"]()[1])
    return lambda: load_mesh(path, 100.0)


# --- networks ---


def chain(
    kind: str, count: int, side: int, second: str = "", arrays: dict[str, np.ndarray] | None = None, *attributes: list
) -> bytes:
    """A network of one operator so many times."""
    nodes = [node(kind, f"v{i} {second}", f"v{i + 1}", *attributes) for i in range(count)]
    axes = [[(1, "axes"), (8, 2), (8, 3), (20, 7)], [(1, "keepdims"), (3, 0), (20, 2)]]
    nodes += [node("ReduceMean", f"v{count}", "h", *axes), node("Gemm", "h m", "y")]
    weights = {"m": np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)} | (arrays or {})
    sizes = [(1, [(2, "n")]), (1, [(1, 3)]), (1, [(1, side)]), (1, [(1, side)])]
    input_place = [(1, "v0"), (2, [(1, [(1, 1), (2, sizes)])])]
    stored = [stored_tensor(name, array) for name, array in weights.items()]
    return protobuf([(1, 8), (7, [*nodes, *stored, (11, input_place), (12, [(1, "y")])]), (8, [(2, 13)])])


def kernel(side: int) -> list:
    """Attributes of a pool that sees so many pixels a side."""
    pads = [(1, "pads"), *[(8, side // 2)] * 4, (20, 7)]
    return [[(1, "kernel_shape"), (8, side), (8, side), (20, 7)], pads]


def square(side: int) -> dict[str, np.ndarray]:
    return {"w": np.eye(side, dtype=np.float32)}


CHAINS: tuple[tuple[int, Callable[[], bytes]], ...] = (
    (512, lambda: chain("MatMul", 3000, 512, "v0")),
    (1024, lambda: chain("MatMul", 3000, 1024, "w", square(1024))),
    (8, lambda: chain("MatMul", 3000, 8, "w", square(8))),
    (2048, lambda: chain("MatMul", 30, 2048, "v0")),
    (1024, lambda: chain("MaxPool", 50, 1024, "", None, *kernel(127))),
    (256, lambda: chain("AveragePool", 50, 256, "", None, *kernel(63))),
    (8, lambda: chain("Elu", 3000, 8)),
    (4096, lambda: chain("Erf", 100, 4096)),
    (8, lambda: chain("Add", 30_000, 8, "v0")),
    (8, lambda: chain("Relu", 33_000, 8)),
    (8, lambda: chain("Concat", 40, 8, "v0", None, [(1, "axis"), (3, 0), (20, 2)])),
    (8, lambda: chain("Sum", 20, 8, "v0 " * 10_000)),
    (8, lambda: chain("Tile", 30, 8, "r", {"r": np.array([1, 1, 2, 2])})),
    (8, lambda: chain("Identity", 30_000, 8)),
    (1024, lambda: chain("Softmax", 2000, 1024)),
    (
        16,
        lambda: chain(
            "Add",
            3000,
            16,
            "k",
            {f"u{i}": np.ones(9, np.float32) for i in range(3000)} | {"k": np.ones(16, np.float32)},
        ),
    ),
)


def network_chain(place: Place, number: int) -> Use:
    from patchproof.classifier import load_classifier

    side, make = of(number, CHAINS)
    (place.given / "n.onnx").write_bytes(make())
    (place.given / "n.json").write_text(json.dumps({"input_px": side, "labels": list("abcd")}))
    return lambda: load_classifier("file:n.onnx", place.given)


def network_message(place: Place, number: int) -> Use:
    from patchproof.classifier import load_classifier

    rng, message = np.random.default_rng(number), onnx_model()
    for _ in range(3):
        message = broken_message(rng, message)
    (place.given / "n.onnx").write_bytes(protobuf(message))
    (place.given / "n.json").write_text(json.dumps({"input_px": 8, "labels": list("abcd")}))
    return lambda: load_classifier("file:n.onnx", place.given)


def network_files(place: Place, number: int) -> Use:
    """A network, its data, its card or its labels that are no file, or lie elsewhere."""
    from patchproof.classifier import load_classifier

    names = ["n.onnx", "n.json", "n.onnx.data", "labels.json"]
    location = of(number, ("../outside/secret.txt", "/etc/passwd", "n.onnx.data", "${OUTSIDE}/secret.txt"))
    external = [[(1, "location"), (2, location)], [(1, "offset"), (2, "0")], [(1, "length"), (2, "192")]]
    weight = (5, [(1, 4), (1, 12), (2, 1), (8, "extra"), *((13, entry) for entry in external), (14, 1)])
    message = onnx_model()
    graph = dict(message)[7]
    (place.given / "n.onnx").write_bytes(protobuf([(1, 8), (7, [*graph, weight]), (8, [(2, 13)])]))
    card = {"input_px": 8, "labels": of(number // 4, ["labels.json", "../outside/secret.txt", "/etc/passwd"])}
    (place.given / "n.json").write_text(json.dumps(card))
    (place.given / of(number, names)).unlink(missing_ok=True)
    endless(place.given / of(number, names), of(number // 4, ENDLESS))
    return lambda: load_classifier("file:n.onnx", place.given)


def network_card(place: Place, number: int) -> Use:
    from patchproof.classifier import load_classifier

    (place.given / "n.onnx").write_bytes(protobuf(onnx_model()))
    (place.given / "n.json").write_bytes(huge_json(np.random.default_rng(number), CARD))
    return lambda: load_classifier("file:n.onnx", place.given)


def weights(place: Place, number: int) -> Use:
    from patchproof.classifier.zoo import read_weights

    path = place.given / "w.safetensors"
    heads = [
        {"a": {"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}},
        {f"a{i}": {"dtype": "F32", "shape": [0] * 500, "data_offsets": [0, 0]} for i in range(300)},
        {"a": {"dtype": "F32", "shape": [2**62, 4], "data_offsets": [0, 0]}},
        {"__metadata__": {"a": "b" * 10_000_000}},
    ]
    if number % 2:
        text = json.dumps(of(number // 2, heads)).encode()
        path.write_bytes(struct.pack("<Q", len(text)) + text)
    else:
        endless(path, of(number // 2, ENDLESS))
    return lambda: read_weights(path)


# --- folders that are written to ---


def album(place: Place, number: int) -> Use:
    """A received folder of a capture: links, odd names."""
    from patchproof.app.capture.album import Album

    folder = place.out / "album"
    (folder / "session_01").mkdir(parents=True)
    if number % 3 == 0:
        (folder / "session_02").symlink_to(place.outside)
    elif number % 3 == 1:
        (folder / of(number // 3, ("session_x", "session_", "session_99999999999999999999", "session_02.5"))).mkdir()
    else:
        (folder / "session_01" / ".photo_0001.part").symlink_to(place.outside / "holiday.jpg")
        (folder / "controls").symlink_to(place.outside)

    def use() -> None:
        loaded = Album(folder)
        for into in (loaded.new_session(), *loaded.sessions, "gray", "../outside"):
            with loaded.incoming(into) as incoming:
                incoming.write(b"\xff\xd8\xff" + into.encode() + bytes(20))
                incoming.keep()

    return use


def own_output(place: Place, number: int) -> Use:
    """An output folder with what is not ours: a report is written over an earlier one."""
    import patchproof as pp

    sheet_with(lambda manifest: None, place)
    report = place.out / "report"
    (report / "pictures").parent.mkdir()
    kept = report / "pictures" / "holiday.jpg"
    if number % 3 == 0:
        (report / "pictures").symlink_to(place.outside)
    elif number % 3 == 1:
        (report / "pictures").mkdir()
        kept.write_bytes(b"somebody's")
    else:
        (report / "report.json").symlink_to(place.outside / "secret.txt")
    photos, sheet = place.given / "photos", place.given / "sheet.json"

    def use() -> None:
        pp.verify(photos, sheet, report, overwrite=True)
        assert number % 3 != 1 or kept.is_file(), "a file that is not ours was deleted"

    return use


def prepared() -> None:
    """Make once what many inputs are made of, and import what is imported late."""
    import importlib

    from fuzz import readers

    late = (
        "patchproof.app.verify patchproof.app.capture.serve patchproof.optimizer.evaluate patchproof.reprints.run_sheet"
    )
    late += " patchproof.optimizer.imported_design patchlab.harden.harden_study patchlab.paper.image_classes"
    late += " patchproof.calibrate.camera patchproof.scene.image_scene patchproof.scene.photo_scene matplotlib.pyplot"
    late += " matplotlib.backends.backend_agg jinja2 pikepdf pypdfium2 scipy.spatial"
    late += " patchproof.mesh.gltf patchproof.mesh.obj patchproof.mesh.ply patchproof.mesh.load_mesh"
    for module in late.split():
        importlib.import_module(module)
    readers.prepared(), manifests(), honest_photo(), small_problem(), readers.profile()


# by name: what makes it, and how many of the inputs
KINDS: dict[str, tuple[Callable[[Place, int], Use], int]] = {
    "sheet: names": (sheet_names, len(NAMES)),
    "sheet: paths": (sheet_paths, 12),
    "sheet: values": (sheet_values, 14),
    "sheet: no file": (sheet_files, 6),
    "pdf: bombs": (pdf, 2 * len(PDF_BOMBS)),
    "pdf: no file": (pdf_files, 6),
    "run: names": (run_names, len(NAMES)),
    "run: values": (run_values, 10),
    "run: pictures": (run_pictures, 12),
    "checkpoint": (checkpoint, 8),
    "log": (resumed_log, 4),
    "journal": (journal, 8),
    "import": (imported_picture, 10),
    "photographs: links": (photo_links, 12),
    "photographs: folders": (photo_folders, 5),
    "photographs: controls": (controls, 6),
    "photographs: bombs": (photo_pictures, 6),
    "photographs: boards": (calibrated_photos, 6),
    "photographs: blank": (blank_photos, 4),
    "backgrounds": (backgrounds, 8),
    "scene": (scene_toml, len(TOMLS) + 4),
    "template": (template, 7),
    "printer": (printer, 8),
    "camera": (camera, 9),
    "icc": (icc, 6),
    "mask, faces": (mask, 8),
    "labels": (labels, 8),
    "harden": (harden, 7),
    "boxes": (boxes, 8),
    "corners": (corners, 20),
    "mesh": (mesh, len(MESHES)),
    "mesh: no file": (mesh_files, 8),
    "network: chains": (network_chain, len(CHAINS)),
    "network: messages": (network_message, 8),
    "network: files": (network_files, 12),
    "network: card": (network_card, 6),
    "weights": (weights, 6),
    "album": (album, 8),
    "output folder": (own_output, 3),
}
