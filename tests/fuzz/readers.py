"""Hostile files for every reader: honest ones with bytes or a part of their structure changed, by a seed.

`READERS` has for each kind of file a function that writes a file made from a generator into a folder, and returns what
reads it. `attempt` reads it under limits and under watch. Whatever ends otherwise than with a result or `Refused` is a
failure; `python tests/test_fuzz.py --fuzz N` looks for more.
"""

from __future__ import annotations

import copy
import dataclasses
import functools
import io
import json
import shutil
import struct
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms
from safetensors.numpy import save as safetensors_bytes

from fuzz.hostile_bytes import (
    PHOTO_KINDS,
    Rng,
    broken_json,
    broken_lines,
    changed,
    large_png,
    large_tiff,
    mutated,
    patterned_jpeg,
    run_length_bmp,
    tweaked,
    whole_photo,
)
from fuzz.watch import MOST_BYTES, SECONDS, TooLong, Watch, limits, peak_bytes, temporary_files_in
from patchproof.base.errors import Refused
from patchproof.optimizer.promise import PromiseOptions

Read = Callable[[], object]


# --- photographs ---


def photo(rng: Rng, folder: Path) -> Read:
    made = [large_tiff, large_png, run_length_bmp, patterned_jpeg]
    if rng.random() < 0.3:
        data = made[rng.integers(len(made))](rng)
    else:
        data = whole_photo(rng, PHOTO_KINDS[rng.integers(len(PHOTO_KINDS))])
    for _ in range(rng.integers(0, 3)):
        data = mutated(rng, data) or b"x"
    path = folder / f"photo.{rng.choice(['jpg', 'png', 'tif', 'gif'])}"
    path.write_bytes(data)
    return lambda: measured(path)


def largest_photo(rng: Rng, folder: Path) -> Read:
    """As many pixels as are read at once, as are read at all, or a few more, with little in them."""
    kind = PHOTO_KINDS[rng.choice([i for i, (_, file, _) in enumerate(PHOTO_KINDS) if file in ("JPEG", "PNG", "TIFF")])]
    pixels, ratio = rng.choice([0.99, 1.01, 1.5, 3.99, 4.01]) * 30e6, float(rng.choice([0.75, 4 / 3, 1.5, 20, 1 / 20]))
    width = min(int(np.sqrt(pixels * ratio)), 60_000)
    path, size = folder / "photo.jpg", (width, min(int(pixels / width), 60_000))
    path.write_bytes(whole_photo(rng, kind, size))
    return lambda: measured(path)


def measured(path: Path) -> None:
    """As `verify` measures a photograph; what it is rejected for is refused here, so that it can be seen in counts."""
    from patchproof.evidence.batch import PhotoItem, _measure_or_reject

    entry = _measure_or_reject(small_task(), PhotoItem(path, path.name, with_pictures=True)).entry
    assert (entry.status == "rejected") <= bool(entry.remark.advice)
    if entry.code not in (None, "too_few_markers"):
        raise Refused("a photograph", entry.code, entry.remark.advice)


# --- JSON ---


@functools.cache
def small_task():
    from synthetic_photos import make_manifest

    from patchproof.channel.printer import identity_printer
    from patchproof.evidence.task import Options, task_of

    return task_of(make_manifest(), Options([], identity_printer()), None)


@functools.cache
def manifests() -> list[dict]:
    """A sheet with a promise and settings, and one in tiles."""
    from synthetic_photos import CONDITION, make_manifest, some_design

    from patchproof.sheets.content import SheetContent
    from patchproof.sheets.manifest import dump_manifest
    from patchproof.sheets.piece import lay_out_piece
    from patchproof.sheets.template import load_template
    from patchproof.sheets.write import write_sheet
    from test_verify_run import promise

    claims = [CONDITION | dict(px_per_mm=2.0, contrast=0.7 + 0.01 * i, blur_px=0.5) for i in range(4)]
    settings = {
        "printer": {"profile": "identity"},
        "camera": {"photo_px": [640, 480], "noise": [0.0, 0.01]},
        "target": {"label": "bright", "accept": []},
        "sheet": {"template": "a4"},
    }
    control = dict(n=400, rate=0.1, interval=[0.0, 0.2], confidence=0.1, difference=0.8, difference_interval=[0.7, 0.9])
    promised = promise(claims) | {"controls": {"gray": control}}
    piece = lay_out_piece((300.0, 300.0), 20.0, "FUZZFUZZ00", "design")
    with tempfile.TemporaryDirectory() as folder:
        content = SheetContent(piece, "FUZZFUZZ00", "design", some_design(), settings=settings)
        tiled = write_sheet(Path(folder) / "a.pdf", load_template("a4_tiles"), content)
    own = json.loads(dump_manifest(make_manifest(promised)))
    return [own | {"settings": settings}, json.loads(dump_manifest(tiled))]


@functools.cache
def honest_photo() -> bytes:
    """A photograph of the first manifest's sheet that is measured."""
    from synthetic_photos import make_manifest, page_raster, photograph, view

    homography = view(10, 5, 550, size_px=(400, 300))
    pixels = photograph(page_raster(make_manifest(), True), homography, (400, 300), blur_px=0.5, fine=2)
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "JPEG", quality=95)
    return buffer.getvalue()


@functools.cache
def network():
    import torch

    from patchproof.classifier import Classifier

    def logits(photos):
        level = photos.mean((1, 2, 3))
        return torch.stack([level * 20, torch.full_like(level, 5.0)], 1)

    return Classifier("net", "ab" * 32, 32, ("bright", "dark"), logits)


def verified(folder: Path, manifest, journal: Path | None = None) -> None:
    """A verification of the honest photograph in the folder, ledger and all."""
    from patchproof.channel.printer import identity_printer
    from patchproof.evidence.gather import gather_evidence
    from patchproof.evidence.task import Options

    photos = folder / "photos"
    photos.mkdir(exist_ok=True)
    (photos / "a.jpg").write_bytes(honest_photo())
    options = Options([network()], identity_printer())
    report = gather_evidence(photos, manifest, options, journal=journal, resume=journal is not None)
    json.dumps(report.model_dump(mode="json"), allow_nan=False)


def sheet_json(rng: Rng, folder: Path) -> Read:
    from patchproof.sheets.manifest import load_manifest

    (folder / "sheet.json").write_bytes(broken_json(rng, manifests()[0 if rng.random() < 0.7 else 1]))
    return lambda: verified(folder, load_manifest(folder / "sheet.json"))


@functools.cache
def journal_lines() -> list[dict]:
    from patchproof.sheets.manifest import Manifest

    with tempfile.TemporaryDirectory() as folder:
        verified(Path(folder), Manifest.model_validate(manifests()[0]), Path(folder) / "photos.jsonl")
        return [json.loads(line) for line in (Path(folder) / "photos.jsonl").read_text().splitlines()]


def photos_jsonl(rng: Rng, folder: Path) -> Read:
    from patchproof.sheets.manifest import Manifest

    change = tweaked if rng.random() < 0.5 else changed
    lines = [line | {"result": change(rng, line["result"])} for line in copy.deepcopy(journal_lines())]
    if rng.random() < 0.3:
        lines = [changed(rng, line) for line in journal_lines()]
    text = "\n".join(map(json.dumps, lines)).encode()
    (folder / "photos.jsonl").write_bytes(mutated(rng, text) if rng.random() < 0.1 else text)
    manifest = Manifest.model_validate(manifests()[0])
    return lambda: verified(folder, manifest, folder / "photos.jsonl")


@functools.cache
def runs_folder() -> tempfile.TemporaryDirectory:
    return tempfile.TemporaryDirectory()  # removed when the process ends


@functools.cache
def finished_run() -> Path:
    """The folder of a finished run, beside its scene."""
    from patchproof.optimizer import run
    from test_optimize import toml

    folder = Path(runs_folder().name)
    kept, run.PROMISE_VIEWS = run.PROMISE_VIEWS, 4
    try:
        run.optimize(
            toml(folder / "scene.toml", optimize__steps=1), folder / "run", promise=PromiseOptions(controls=("bare",))
        )
    finally:
        run.PROMISE_VIEWS = kept
    return folder / "run"


def copied_run(folder: Path) -> Path:
    shutil.copytree(finished_run(), folder / "run")
    shutil.copy(finished_run().parent / "scene.toml", folder)
    return folder / "run"


def run_json(rng: Rng, folder: Path) -> Read:
    from patchproof.optimizer.run import load_run

    run = copied_run(folder)
    if rng.random() < 0.2:
        (run / "design.png").write_bytes(mutated(rng, (run / "design.png").read_bytes()))
    else:
        (run / "run.json").write_bytes(broken_json(rng, json.loads((run / "run.json").read_text())))
    return lambda: load_run(run)


@functools.cache
def small_problem():
    from patchproof.optimizer.problem import set_problem
    from patchproof.scene.scene import load_scene

    return set_problem(load_scene(finished_run().parent / "scene.toml"))


def checkpoint(rng: Rng, folder: Path) -> Read:
    from patchproof.optimizer.loop import CHECKPOINT_FILE, load_checkpoint

    data, problem = (finished_run() / CHECKPOINT_FILE).read_bytes(), small_problem()
    size = int.from_bytes(data[:8], "little")
    if rng.random() < 0.3:
        data = mutated(rng, data)
    else:
        head = json.loads(data[8 : 8 + size])
        if rng.random() < 0.6:
            note = broken_json(rng, json.loads(head["__metadata__"]["state"])).decode("utf-8", "replace")
            head["__metadata__"]["state"] = note
        else:
            head = changed(rng, head)
        text = json.dumps(head).encode()
        data = len(text).to_bytes(8, "little") + text + data[8 + size :]
    (folder / CHECKPOINT_FILE).write_bytes(data)
    return lambda: load_checkpoint(folder, problem)


def other_tensors(rng: Rng, folder: Path) -> Read:
    """A checkpoint with whole tensors of other shapes, types and values."""
    from patchproof.optimizer.loop import CHECKPOINT_FILE, load_checkpoint

    problem = small_problem()
    names = ["design", "best", *(f"{kind}{n}" for kind in ("mean", "square") for n in range(4))]
    shapes = [(3, 8, 8), (0,), (1, 1), (3, 64, 64), ()]
    kinds = (np.float32, np.float64, np.int64)
    tensors = {
        name: np.full(shapes[rng.integers(5)], np.nan if rng.random() < 0.2 else 1).astype(
            kinds[rng.integers(3)], casting="unsafe"
        )
        if rng.random() < 0.9
        else np.zeros(1)
        for name in names
    }
    note = {"number": 1, "best_loss": "0x1p0", "sheet_id": problem.scene.sheet_id}
    (folder / CHECKPOINT_FILE).write_bytes(safetensors_bytes(tensors, {"state": json.dumps(note)}))
    return lambda: load_checkpoint(folder, problem)


PLACE = {
    "sheet_id": "ABCDEFGHIJ",
    "front": "+z",
    "at": [1.0, 2.0, 3.0],
    "spin_deg": 0.0,
    "lead": {"value": 0.1, "low": 0.0, "high": 0.2, "n": 24},
    "passes": 10,
    "candidates": [
        {
            "at": "+z",
            "spin_deg": 0.0,
            "family": "side",
            "gap_mm": 0.1,
            "overhang_share": 0.0,
            "gray": 0.1,
            "outlook": 0.1,
        }
    ],
}
CAMERA = {
    "name": "phone",
    "method": "assumed",
    "when": "2024-01-01",
    "instrument": "none",
    "uncertainty": "none",
    "image_px": [4000, 3000],
    "fx": 3000.0,
    "fy": 3000.0,
    "cx": 2000.0,
    "cy": 1500.0,
    "k1": 0.1,
    "k2": -0.05,
    "p1": 0.001,
    "p2": 0.0,
    "k3": 0.0,
}


def place_json(rng: Rng, folder: Path) -> Read:
    from patchproof.optimizer.place_files import read_place

    (folder / "place.json").write_bytes(broken_json(rng, PLACE))
    return lambda: read_place(folder)


def camera_json(rng: Rng, folder: Path) -> Read:
    from patchproof.channel.lens import load_camera

    (folder / "camera.json").write_bytes(broken_json(rng, CAMERA))

    def read() -> None:
        camera = load_camera(str(folder / "camera.json"))
        camera.pinhole_frame((400, 300))
        camera.undistort_points(np.array([[10.0, 10.0]]), (400, 300))

    return read


def printer(rng: Rng, folder: Path) -> Read:
    from patchproof.base.packaged import packaged_path
    from patchproof.channel.printer import SIZE, load_printer

    source = packaged_path("calibration", "printers")
    head, tables = (source / "coated.json").read_text(), (source / "coated.npz").read_bytes()
    how = rng.integers(3)
    if how == 0:
        head = broken_json(rng, json.loads(head)).decode("utf-8", "replace")
    elif how == 1:
        tables = mutated(rng, tables)
    else:
        shapes = [(SIZE,) * 3, (10**6, 10**5), (SIZE, SIZE, SIZE, 3), (-1, 3), (), (2**62,)]
        kinds = ["|u1", "<u2", "<f8", "|O", "<M8[s]", "<U9999999", "|V0"]
        buffer = io.BytesIO()
        packing = [zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2][rng.integers(4)]
        with zipfile.ZipFile(buffer, "w", packing) as archive:
            for name in ("lut", "gamut"):
                text = str(
                    {
                        "descr": str(rng.choice(kinds)),
                        "fortran_order": bool(rng.random() < 0.2),
                        "shape": shapes[rng.integers(6)],
                    }
                )
                text = (text if rng.random() < 0.9 else "(" * 9000).encode() + b"\n"
                content = (
                    b"\x93NUMPY\x01\x00"
                    + struct.pack("<H", len(text))
                    + text
                    + bytes(int(rng.choice([0, 35937, 107811])))
                )
                archive.writestr(f"{name}.npy", content)
        tables = buffer.getvalue() if rng.random() < 0.8 else mutated(rng, buffer.getvalue())
    (folder / "p.json").write_text(head, encoding="utf-8", errors="replace")
    (folder / "p.npz").write_bytes(tables)
    return lambda: load_printer(str(folder / "p.npz"))


@functools.cache
def profile() -> bytes:
    """A display's profile that says it is a printer's."""
    data = bytearray(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    data[12:16] = b"prtr"
    return bytes(data)


def icc(rng: Rng, folder: Path) -> Read:
    from patchproof.calibrate.icc import bake

    (folder / "p.icc").write_bytes(mutated(rng, profile()))
    return lambda: bake(folder / "p.icc", "p", bool(rng.random() < 0.5))


# --- text ---

FACES = "0\n2-5\n# a comment\n7 # eight\n"
LABELS = 'a.png,jeep\nb.png,"cat, tabby"\nc.png,3\n'
CARD = {"input_px": 16, "labels": ["a", "b", "c"]}


def labels_csv(rng: Rng, folder: Path) -> Read:
    from patchlab.harden.labeled_photos import list_labeled_files
    from patchlab.paper.image_classes import labels_with_images

    (folder / "labels.csv").write_bytes(broken_lines(rng, LABELS))
    for name in "abc":
        Image.new("RGB", (4, 4)).save(folder / f"{name}.png")
    return lambda: (
        labels_with_images(folder, folder / "labels.csv"),
        list_labeled_files(folder, folder / "labels.csv"),
    )


CORNERS = "file,x1,y1,x2,y2,x3,y3,x4,y4\ns/a.jpg,10,10,90,12,88,70,9,66\nb.jpg,1.5,2,30,2,30,40,1,40\n"


def corners_coco() -> dict[str, object]:
    """Corners as annotation tools write them: a polygon, and keypoints."""
    names = enumerate(("a.jpg", "s/b.jpg"))
    images = [{"id": i, "file_name": name, "width": 400, "height": 300} for i, name in names]
    keypoints = [1, 2, 2, 30, 2, 2, 30, 40, 2, 1, 40, 1]
    polygon = [10, 10, 90, 12, 88, 70, 9, 66]
    return {
        "images": images,
        "annotations": [{"image_id": 0, "segmentation": [polygon]}, {"image_id": 1, "keypoints": keypoints}],
    }


def corners(rng: Rng, folder: Path) -> Read:
    from patchproof.evidence.annotations import corners_of_photo, load_corners

    is_csv = rng.random() < 0.5
    path = folder / ("c.csv" if is_csv else "c.json")
    path.write_bytes(broken_lines(rng, CORNERS) if is_csv else broken_json(rng, corners_coco()))
    Image.new("RGB", (400, 300)).save(folder / "a.jpg")

    def read() -> None:
        named = load_corners(path)
        for name in named:
            corners_of_photo(named[name], name, folder / "a.jpg")

    return read


def faces_txt(rng: Rng, folder: Path) -> Read:
    from patchproof.scene.texture_scene import _read_faces

    (folder / "faces.txt").write_bytes(broken_lines(rng, FACES))
    return lambda: _read_faces(folder / "faces.txt", 12)


def card_json(rng: Rng, folder: Path) -> Read:
    from patchproof.classifier.network_file import load_network

    (folder / "n.onnx").write_bytes(protobuf(onnx_model()))
    (folder / "n.json").write_bytes(broken_json(rng, CARD))
    return lambda: load_network(folder / "n.onnx")


# a protobuf message as pairs of a field's number and what it holds: a number, bytes, text or another message
Message = list[tuple[int, "int | bytes | str | Message"]]


def node(kind: str, inputs: str, output: str, *attributes: Message) -> tuple[int, Message]:
    """A node of an ONNX graph."""
    words = [(1, word) for word in inputs.split()]
    return 1, [*words, (2, output), (4, kind), *((5, attribute) for attribute in attributes)]


def stored_tensor(name: str, array: np.ndarray) -> tuple[int, Message]:
    """An initializer of an ONNX graph."""
    kind = 1 if array.dtype == np.float32 else 7
    return 5, [*((1, size) for size in array.shape), (2, kind), (8, name), (9, array.tobytes())]


def onnx_model() -> Message:
    """A convolution, a pool and a matrix product, with a shape that is computed: N×3×8×8 → N×4."""
    noise = np.random.default_rng(0).normal(size=(4, 3, 3, 3)).astype(np.float32)
    pads: Message = [(1, "pads"), *((8, 1) for _ in range(4)), (20, 7)]
    window: Message = [(1, "kernel_shape"), (8, 2), (8, 2), (20, 7)]
    axis: Message = [(1, "axis"), (3, 0), (20, 2)]
    nodes = [
        node("Conv", "x w", "a", pads),
        node("Relu", "a", "b"),
        node("MaxPool", "b", "c", window, [(1, "strides"), (8, 2), (8, 2), (20, 7)]),
        node("Shape", "c", "d"),
        node("Gather", "d zero", "e", axis),
        node("Concat", "e rest", "f", axis),
        node("Reshape", "c f", "g"),
        node("ReduceMean", "g", "h", [(1, "axes"), (8, 2), (20, 7)], [(1, "keepdims"), (3, 0), (20, 2)]),
        node("Gemm", "h m", "y"),
    ]
    arrays = {
        "w": noise,
        "m": noise[..., 0, 0].repeat(2, 1)[:, :4],
        "zero": np.zeros(1, int),
        "rest": np.array([4, -1]),
    }
    sizes: Message = [(1, [(2, "n")]), (1, [(1, 3)]), (1, [(1, 8)]), (1, [(1, 8)])]
    place: Message = [(1, "x"), (2, [(1, [(1, 1), (2, sizes)])])]
    weights = [stored_tensor(name, array) for name, array in arrays.items()]
    return [(1, 8), (7, [*nodes, *weights, (11, place), (12, [(1, "y")])]), (8, [(2, 13)])]


def protobuf(message: Message) -> bytes:
    """The message as its file holds it."""

    def varint(number: int) -> bytes:
        return bytes([number & 127 | 128]) + varint(number >> 7) if number > 127 else bytes([number])

    def field(number: int, content) -> bytes:
        if isinstance(content, int):
            return varint(number << 3) + varint(content % (1 << 64))
        data = content.encode("utf-8", "replace") if isinstance(content, str) else content
        data = protobuf(data) if isinstance(data, list) else data
        return varint(number << 3 | 2) + varint(len(data)) + data

    return b"".join(field(number, content) for number, content in message)


def broken_message(rng: Rng, message: Message) -> Message:
    """One field in it, or in a message in it, made another, dropped, doubled, moved or renumbered."""
    at = int(rng.integers(len(message)))
    number, content = message[at]
    if isinstance(content, list) and content and rng.random() < 0.9:
        return [*message[:at], (number, broken_message(rng, content)), *message[at + 1 :]]
    words = [
        "",
        "x",
        "a",
        "w",
        "y",
        "zero",
        "Loop",
        "Tile",
        "Expand",
        "Identity",
        "Split",
        "Cast",
        "Range",
        "Pad",
        "axes",
    ]
    numbers = [0, 1, -1, 2, 3, 64, 1 << 16, 1 << 31, 1 << 62, -(1 << 63)]
    if isinstance(content, int):
        content = int(rng.choice(numbers))
    elif isinstance(content, str):
        content = str(rng.choice(words))
    how = rng.integers(8)
    if how == 0:
        return message[:at] + message[at + 1 :]
    if how == 1:
        return [*message, message[at]]
    if how == 2:
        return [*message[:at], message[rng.integers(len(message))], *message[at + 1 :]]
    if how == 3:
        return [*message[:at], (int(rng.integers(1, 26)), content), *message[at + 1 :]]
    if how == 4 and isinstance(content, bytes):
        content = mutated(rng, content)
    return [*message[:at], (number, content), *message[at + 1 :]]


def onnx_file(rng: Rng, folder: Path) -> Read:
    from patchproof.classifier import load_classifier

    message = onnx_model()
    for _ in range(rng.integers(0, 4)):
        message = broken_message(rng, message)
    stored = protobuf(message)
    (folder / "n.onnx").write_bytes(mutated(rng, stored) if rng.random() < 0.3 else stored)
    (folder / "n.json").write_text(json.dumps({"input_px": 8, "labels": ["a", "b", "c", "d"]}))
    if rng.random() < 0.2:
        (folder / "n.onnx.data").write_bytes(bytes(int(rng.integers(0, 500))))
    return lambda: load_classifier("file:n.onnx", folder)


def mask(rng: Rng, folder: Path) -> Read:
    from patchproof.base.settings import BackgroundSettings
    from patchproof.scene.backgrounds import load_backgrounds
    from patchproof.scene.texture_scene import _read_mask

    pictures = folder / "pictures"
    pictures.mkdir()
    data = [large_png(rng), whole_photo(rng, PHOTO_KINDS[rng.integers(len(PHOTO_KINDS))])][rng.integers(2)]
    (pictures / "a.png").write_bytes(mutated(rng, data))
    if rng.random() < 0.5:
        return lambda: _read_mask(pictures / "a.png")
    return lambda: load_backgrounds(BackgroundSettings(images="pictures"), folder)


def scene_toml(rng: Rng, folder: Path) -> Read:
    from conftest import SCENE

    from patchproof.scene.scene import load_scene

    (folder / "scene.toml").write_bytes(broken_lines(rng, SCENE))
    return lambda: load_scene(folder / "scene.toml")


TEMPLATES = ("a4", "blank_a4", "chart_a4", "charuco_a4", "a4_tiles")


def template_toml(rng: Rng, folder: Path) -> Read:
    from patchproof.base.packaged import packaged_path
    from patchproof.sheets.blank import blank_page
    from patchproof.sheets.page import refuse_larger_than_page
    from patchproof.sheets.piece import lay_out_piece
    from patchproof.sheets.template import load_template

    name = str(rng.choice(TEMPLATES))
    text = packaged_path("print_templates", f"{name}.toml").read_text(encoding="utf-8")
    (folder / "t.toml").write_bytes(broken_lines(rng, text))
    if name in ("a4", "a4_tiles"):
        piece = lay_out_piece((150.0, 150.0), 15.0, "FUZZFUZZ00", "design")
        return lambda: refuse_larger_than_page(load_template(folder / "t.toml"), piece)
    return lambda: blank_page(folder / "t.pdf", template=str(folder / "t.toml"))


# --- meshes and pages ---


@functools.cache
def meshes() -> dict[str, dict[str, bytes]]:
    """A textured box as GLB, OBJ with its files, PLY and STL, by suffix: file names and contents."""
    import trimesh

    uv = np.random.default_rng(0).random((8, 2))
    box = trimesh.creation.box((3, 2, 1))
    picture = Image.fromarray(np.random.default_rng(1).integers(0, 255, (8, 8, 3), np.uint8))
    box.visual = trimesh.visual.TextureVisuals(uv=uv, image=picture)
    obj, files = trimesh.exchange.obj.export_obj(box, return_texture=True)
    plain = trimesh.creation.box((3, 2, 1))
    scene = trimesh.Scene(box)
    scene.add_geometry(
        plain, parent_node_name=next(iter(scene.graph.nodes_geometry)), transform=np.diag([2, 2, 2, 1.0])
    )
    return {
        "glb": {"m.glb": trimesh.exchange.gltf.export_glb(scene)},
        "obj": {"m.obj": obj.encode(), **files},
        "ply": {"m.ply": trimesh.exchange.ply.export_ply(plain, encoding="ascii")},
        "stl": {"m.stl": trimesh.exchange.stl.export_stl(plain)},
    }


def broken_glb(rng: Rng, data: bytes) -> bytes:
    """Its JSON changed: accessors, views, nodes in circles, empty arrays."""
    size = int.from_bytes(data[12:16], "little")
    tree, binary = json.loads(data[20 : 20 + size]), data[20 + size :]
    for _ in range(rng.integers(1, 4)):
        part = str(rng.choice(list(tree)))
        if part == "nodes" and tree["nodes"] and rng.random() < 0.6:
            tree["nodes"][int(rng.integers(len(tree["nodes"])))]["children"] = rng.integers(
                0, len(tree["nodes"]), 2
            ).tolist()
        elif part == "accessors" and tree["accessors"] and rng.random() < 0.6:
            accessor = tree["accessors"][int(rng.integers(len(tree["accessors"])))]
            accessor["count"] = int(rng.choice([0, 1, 10**12, -3, 7]))
            if rng.random() < 0.3:
                accessor.pop("bufferView", None)
        else:
            tree[part] = changed(rng, tree[part])
            if not isinstance(tree[part], list | dict):
                break
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    return (
        data[:8]
        + struct.pack("<I", 20 + len(text) + len(binary))
        + struct.pack("<I", len(text))
        + b"JSON"
        + text
        + binary
    )


def mesh(rng: Rng, folder: Path) -> Read:
    from patchproof.mesh.load_mesh import load_mesh

    kind = str(rng.choice(["glb", "glb", "obj", "ply", "stl"]))
    files = dict(meshes()[kind])
    name = str(rng.choice(list(files)))
    if kind == "glb" and rng.random() < 0.8:
        files[name] = broken_glb(rng, files[name])
    elif kind in ("obj", "ply") and rng.random() < 0.6 and not name.endswith("png"):
        files[name] = broken_lines(rng, files[name].decode())
    else:
        files[name] = mutated(rng, files[name])
    for file, content in files.items():
        (folder / file).write_bytes(content)
    return lambda: load_mesh(folder / f"m.{kind}", 100.0)


@functools.cache
def page() -> bytes:
    """A sheet's PDF with little on it."""
    from patchproof.sheets.blank import blank_sheet

    with tempfile.TemporaryDirectory() as folder:
        blank_sheet("blank_a4", Path(folder) / "s.pdf")
        return (Path(folder) / "s.pdf").read_bytes()


def pdf(rng: Rng, folder: Path) -> Read:
    import pikepdf

    from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

    path = folder / "s.pdf"
    data = page()
    if rng.random() < 0.5:
        with pikepdf.open(io.BytesIO(data)) as opened:
            name = next(iter(opened.attachments))
            stream = opened.attachments[name].get_file().obj
            how = rng.integers(5)
            if how == 0:
                stream.write(bytes(50_000_000))
            elif how == 1:
                stream.write(broken_json(rng, json.loads(stream.read_bytes())))
            elif how == 2:
                opened.pages[0].mediabox = [0, 0, float(rng.choice([0, -5, 1e9, 1e-9])), 800]
            elif how == 3:
                opened.pages[0].Contents = opened.make_stream(mutated(rng, opened.pages[0].Contents.read_bytes()))
            else:
                opened.pages[0].obj["/Resources"] = pikepdf.Dictionary(
                    Font=pikepdf.Array([]), XObject=pikepdf.Name("/A")
                )
            buffer = io.BytesIO()
            opened.save(buffer)
        data = buffer.getvalue()
    path.write_bytes(mutated(rng, data) if rng.random() < 0.6 else data)
    reads = [lambda: attached_manifests(path), lambda: rasterize_page(path, 1, 20.0)]
    return reads[rng.integers(2)]


def long_path(rng: Rng, folder: Path) -> Read:
    """Names that no system takes, wherever a path is."""
    import patchproof as pp
    from patchproof.calibrate.icc import bake
    from patchproof.channel.lens import load_camera
    from patchproof.channel.printer import load_printer
    from patchproof.mesh.load_mesh import load_mesh
    from patchproof.photo.read import list_photos
    from patchproof.scene.image_scene import read_labels
    from patchproof.sheets.manifest import load_manifest
    from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

    name = str(rng.choice(["x" * 300, "a\0b", "d/" * 2500, "ä" * 200, "\udcff" * 200, "."]))
    readers = [load_manifest, list_photos, attached_manifests, rasterize_page, pp.load_run, pp.load_scene]
    readers += [
        lambda p: read_labels(p, folder),
        lambda p: load_printer(f"{p}.npz"),
        lambda p: load_camera(f"{p}.json"),
        lambda p: load_mesh(f"{p}.obj", 1.0),
    ]
    readers += [lambda p: bake(p, "p"), lambda p: pp.verify(folder, folder / "no.json", p)]
    reader = readers[rng.integers(len(readers))]
    return lambda: reader(folder / name)


# name: (what makes it, how many of a hundred inputs)
READERS: dict[str, tuple[Callable[[Rng, Path], Read], int]] = {
    "photo": (photo, 30),
    "largest photo": (largest_photo, 1),
    "sheet.json": (sheet_json, 7),
    "photos.jsonl": (photos_jsonl, 4),
    "run.json": (run_json, 5),
    "checkpoint": (checkpoint, 5),
    "other tensors": (other_tensors, 2),
    "place.json": (place_json, 3),
    "camera": (camera_json, 4),
    "printer": (printer, 6),
    "icc": (icc, 2),
    "labels.csv": (labels_csv, 4),
    "faces.txt": (faces_txt, 3),
    "corners": (corners, 3),
    "network card": (card_json, 3),
    "onnx": (onnx_file, 4),
    "mask, background": (mask, 4),
    "scene.toml": (scene_toml, 3),
    "template": (template_toml, 3),
    "mesh": (mesh, 7),
    "pdf": (pdf, 3),
    "path": (long_path, 2),
}


# --- reading under watch ---


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What reading one input came to: `how` is "read", "refused" or a traceback."""

    reader: str
    seed: int
    how: str
    seconds: float
    bytes: int


def attempt(reader: str, seed: int, watch: Watch) -> Outcome:
    """Make the input of that seed in a folder of its own and read it."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        read = READERS[reader][0](rng, Path(name))
        prepared()
        before, begin = peak_bytes(reset=True), time.process_time()
        with watch.on(Path(name)), temporary_files_in(name), limits():
            how = ended(read)
        seconds, most = time.process_time() - begin, max(0, peak_bytes() - before)
        if watch.events:
            how = f"did {watch.events[:3]}"
        elif most > MOST_BYTES or seconds > SECONDS:
            how = f"took {seconds:.1f} s of processor time and {most / 1e6:.0f} MB"
        return Outcome(reader, seed, how, seconds, most)


def ended(read: Read) -> str:
    try:
        read()
        return "read"
    except Refused as refusal:
        text = str(refusal)
        return "refused" if "xpected" in text and "\n" not in text and len(text) < 4000 else f"said {text[:300]!r}"
    except (Exception, TooLong):
        return traceback.format_exc()


@functools.cache
def prepared() -> None:
    """Import once what readers import late, so that it is no part of one input's time and memory."""
    import importlib

    late = "pikepdf pypdfium2 trimesh.exchange.load scipy.spatial safetensors matplotlib torch"
    for module in late.split():
        importlib.import_module(module)
