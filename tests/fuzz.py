"""Hostile files for every reader: honest ones with bytes or a part of their structure changed, by a seed.

`READERS` has for each kind of file a function that writes a file made from a generator into a folder, and returns what
reads it. `attempt` reads it under limits and under watch. Whatever ends otherwise than with a result or `Refused` is a
failure; `python tests/test_fuzz.py --fuzz N` looks for more.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import functools
import io
import json
import os
import re
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms
from safetensors.numpy import save as safetensors_bytes

from patchproof.strict import Refused

Rng = np.random.Generator
Read = Callable[[], object]
SECONDS, MOST_BYTES = 20.0, 2_000_000_000  # a photograph's own limits are 10 s and 1 GB, a long call into OpenCV added

PHOTO_KINDS = [
    ("RGB", "JPEG", {"quality": 80}),
    ("RGB", "JPEG", {"progressive": True}),
    ("CMYK", "JPEG", {}),
    ("L", "JPEG", {}),
    ("RGB", "PNG", {}),
    ("RGBA", "PNG", {}),
    ("P", "PNG", {}),
    ("I;16", "PNG", {}),
    ("RGB", "TIFF", {"compression": "tiff_lzw"}),
    ("CMYK", "TIFF", {}),
    ("F", "TIFF", {}),
    ("RGB", "WEBP", {}),
    ("RGB", "BMP", {}),
    ("P", "GIF", {}),
    ("P", "GIF", {"animated": True}),
]


def whole_photo(rng: Rng, kind) -> bytes:
    """A small valid picture of a kind."""
    mode, file_format, options = kind
    pixels = rng.integers(0, 256, (24, 32, 3), np.uint8)
    if mode == "I;16":
        image = Image.fromarray(pixels[..., 0].astype(np.uint16) * 257)
    elif mode == "F":
        image = Image.fromarray(pixels[..., 0].astype(np.float32) / 255)
    else:
        image = Image.fromarray(pixels).convert(mode)
    options, buffer = dict(options), io.BytesIO()
    if options.pop("animated", False):
        options |= {"save_all": True, "append_images": [image.rotate(90), image.rotate(180)]}
    image.save(buffer, file_format, **options)
    return buffer.getvalue()


def mutated(rng: Rng, data: bytes) -> bytes:
    """Cut, overwritten, with a piece doubled or dropped, or with huge numbers in its header."""
    data, how = bytearray(data), rng.integers(6)
    at = int(rng.integers(len(data)))
    if how == 0:
        return bytes(data[:at])
    if how == 1:
        for place in rng.integers(0, len(data), rng.integers(1, 20)):
            data[place] = rng.integers(256)
    elif how == 2:
        for place in rng.integers(0, min(len(data), 64), 3):
            data[place] = rng.choice([0, 127, 128, 255])
    elif how == 3:
        data[at:at] = data[: rng.integers(1, 200)]
    elif how == 4:
        del data[at : at + int(rng.integers(1, 50))]
    else:
        start = int(rng.integers(0, min(len(data), 40)))
        data[start : start + 4] = b"\x7f\xff\xff\xff"
    return bytes(data)


ODD = [None, True, -1, 0, 1e308, "", "x" * 1000, [], {}, [[]], {"a": 1}, float("nan"), float("inf"), -1e-300]
ODDER = [2**63, 10**30, "\0", "../" * 90, "ä\ud800", "module:os.system", [[[[]]]], [0] * 5000, "1e9", {"a": {"a": {}}}]


def changed(rng: Rng, value):
    """The same JSON value with one thing in it made wrong."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = str(rng.choice(list(value)))
        if rng.random() < 0.15:
            return {k: v for k, v in value.items() if k != key}
        return value | {key: changed(rng, value[key])}
    if isinstance(value, list) and value and rng.random() < 0.85:
        at = int(rng.integers(len(value)))
        return [*value[:at], *([] if rng.random() < 0.15 else [changed(rng, value[at])]), *value[at + 1 :]]
    odd = ODD + ODDER
    return odd[rng.integers(len(odd))]


def tweaked(rng: Rng, value):
    """The same JSON value with one number in it made another, in place."""
    places = list(numbers_in(value))
    if places:
        table, key = places[rng.integers(len(places))]
        number = table[key]
        table[key] = type(number)(
            number * rng.choice([-1, 0, 0.01, 0.5, 0.9, 1, 1.1, 2, 30, 1e4]) + rng.integers(-1, 2)
        )
    return value


def numbers_in(value) -> Iterator[tuple]:
    """(list or dictionary, index or key) of every number."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        if type(item) in (int, float):
            yield value, key
        yield from numbers_in(item)


def broken_json(rng: Rng, value) -> bytes:
    """JSON with one to three things changed in it, or broken text."""
    if rng.random() < 0.1:
        return mutated(rng, json.dumps(value).encode())
    if rng.random() < 0.02:
        return b"[" * 100_000
    value = copy.deepcopy(value)
    for _ in range(rng.choice([1, 1, 2, 3])):
        value = tweaked(rng, value) if rng.random() < 0.6 else changed(rng, value)
    return json.dumps(value).encode()


def broken_lines(rng: Rng, text: str) -> bytes:
    """A text with a word changed in some of its lines, lines doubled and dropped, or broken bytes."""
    if rng.random() < 0.3:
        return mutated(rng, text.encode())
    lines = text.splitlines()
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(lines)))
        words = re.split(r"([ ,=/])", lines[at])
        odd = ["", "0", "-1", "1e308", "nan", "99999999999", "x" * 300, "\0", "[" * 2000, '"', "1.5", "-0", "\udc80"]
        words[int(rng.integers(len(words)))] = str(rng.choice(odd))
        lines[at : at + 1] = ["".join(words)] * int(rng.choice([1, 1, 1, 0, 2]))
        lines = lines or [""]
    return "\n".join(lines).encode("utf-8", "surrogateescape")


# --- photographs ---


def tiff(width: int, height: int, tags: dict[int, tuple[int, list[int]]], data: bytes) -> bytes:
    """A TIFF of those tags (type, values), with pixel data from byte 8 on."""
    tags = {256: (4, [width]), 257: (4, [height])} | tags
    extra, entries = b"", []
    for tag, (kind, values) in sorted(tags.items()):
        packed = struct.pack(f"<{len(values)}{'H' if kind == 3 else 'I'}", *values)
        if len(packed) > 4:
            packed, extra = struct.pack("<I", 8 + len(data) + len(extra)), extra + packed
        entries.append(struct.pack("<HHI", tag, kind, len(values)) + packed.ljust(4, b"\0"))
    head = b"II*\0" + struct.pack("<I", 8 + len(data) + len(extra))
    return head + data + extra + struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)


def large_tiff(rng: Rng) -> bytes:
    """Many strips or tiles of a picture that is much larger than its file."""
    packed, size = zlib.compress(bytes(768)), int(rng.choice([64, 1000, 3000]))
    tags = {258: (3, [8, 8, 8]), 259: (3, [int(rng.choice([1, 5, 8, 7, 34925, 50000]))]), 262: (3, [2]), 277: (3, [3])}
    if rng.random() < 0.5:
        side = int(rng.choice([16, 64, 16000, 2**31]))
        count = min(max(1, -(-size // side)) ** 2, 40_000)
        tags |= {322: (4, [side]), 323: (4, [side]), 324: (4, [8] * count), 325: (4, [len(packed)] * count)}
    else:
        rows = int(rng.choice([1, 7, 2**32 - 1]))
        count = min(max(1, -(-size // rows)), 40_000)
        tags |= {278: (4, [rows]), 273: (4, [8] * count), 279: (4, [len(packed)] * count)}
    return tiff(size, size, tags, packed)


def large_png(rng: Rng) -> bytes:
    """Chunks with honest sums and dishonest content: sizes, palettes, profiles, text."""
    side = int(rng.choice([1, 500, 4000, 2**31 - 1]))
    depth, color = int(rng.choice([1, 2, 4, 8, 16, 3])), int(rng.choice([0, 2, 3, 4, 6]))
    head = struct.pack(">IIBBBBB", side, int(rng.choice([1, 500, 3000])), depth, color, 0, 0, int(rng.integers(3)))
    bomb = zlib.compress(bytes(2_000_000))
    parts = [
        (b"IHDR", head),
        (b"PLTE", bytes(9)),
        (b"tRNS", bytes(3)),
        (b"iCCP", b"a\0\0" + bomb),
        (b"zTXt", b"a\0\0" + bomb),
    ]
    parts += [(b"eXIf", mutated(rng, exif_bytes(rng))), (b"IDAT", bomb), (b"IEND", b"")]
    kept = [part for part in parts if part[0] in (b"IHDR", b"IDAT") or rng.random() < 0.7]

    def chunk(name: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    return b"\x89PNG\r\n\x1a\n" + b"".join(chunk(*part) for part in kept)


def exif_bytes(rng: Rng) -> bytes:
    exif = Image.Exif()
    exif[0x0112], exif[0x0131] = int(rng.integers(0, 10)), "x" * int(rng.integers(0, 50))
    exif.get_ifd(0x8769).update({0xA405: int(rng.integers(0, 100)), 0xA404: 1.5, 0x9003: "2024:01:02 03:04:05"})
    return exif.tobytes()


def run_length_bmp(rng: Rng) -> bytes:
    """A BMP whose runs are read by Python, with sizes that its data do not fill."""
    width, height = (int(rng.choice([1, 300, 3000, 2**31 - 1])) for _ in range(2))
    runs = rng.integers(0, 256, int(rng.integers(2, 40_000)), np.uint8).tobytes()
    if rng.random() < 0.5:
        runs = b"\xff\0" * int(rng.integers(1, 40_000))
    head = struct.pack(
        "<IiiHHIIiiII", 40, width, height, 1, int(rng.choice([4, 8])), int(rng.choice([1, 2])), len(runs), 0, 0, 256, 0
    )
    return b"BM" + struct.pack("<IHHI", 1078 + len(runs), 0, 0, 1078) + head + bytes(1024) + runs


def patterned_jpeg(rng: Rng) -> bytes:
    """A picture full of what detectors look for: squares, finder patterns of QR codes, noise."""
    side, kind = int(rng.choice([60, 120, 160])), rng.integers(4)
    y, x = np.mgrid[:side, :side]
    if kind == 0:
        gray = ((y // 12 + x // 12) % 2 * 255).astype(np.uint8)
    elif kind == 1:
        gray = np.where((y % 24 < 12) & (x % 24 < 12), 0, 255).astype(np.uint8)
    elif kind == 2:
        distance = np.maximum(abs(y % 24 - 8), abs(x % 24 - 8)) // 2
        gray = np.where((distance == 2) | (distance > 3), 255, 0).astype(np.uint8)
    else:
        gray = rng.integers(0, 256, (side, side), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(gray).convert("RGB").save(buffer, "JPEG", quality=90, exif=exif_bytes(rng))
    return buffer.getvalue()


def photo(rng: Rng, folder: Path) -> Read:
    from patchproof.evidence.batch import Item, _measured
    from patchproof.evidence.grouping import group

    made = [large_tiff, large_png, run_length_bmp, patterned_jpeg]
    if rng.random() < 0.3:
        data = made[rng.integers(len(made))](rng)
    else:
        data = whole_photo(rng, PHOTO_KINDS[rng.integers(len(PHOTO_KINDS))])
    for _ in range(rng.integers(0, 3)):
        data = mutated(rng, data) or b"x"
    path = folder / f"photo.{rng.choice(['jpg', 'png', 'tif', 'gif'])}"
    path.write_bytes(data)

    def read() -> None:
        group(folder)
        result = _measured(small_task(), Item(path, path.name, with_pictures=True))
        assert (result.entry.status == "rejected") <= bool(result.entry.remark.advice)
        if result.entry.code not in (None, "too_few_markers"):
            raise Refused(
                "a photograph", result.entry.code, result.entry.remark.advice
            )  # that it can be seen in counts

    return read


# --- JSON ---


@functools.cache
def small_task():
    from patchproof.channel.printer import identity_printer
    from patchproof.evidence.task import Options, task_of
    from test_photo_synthetic import make_manifest

    return task_of(make_manifest(), Options([], identity_printer()), None)


@functools.cache
def manifests() -> list[dict]:
    """A sheet with a promise and settings, and one in tiles."""
    from patchproof.sheets.content import PrintedPiece
    from patchproof.sheets.manifest import dump_manifest
    from patchproof.sheets.piece import lay_out_piece
    from patchproof.sheets.template import load_template
    from patchproof.sheets.write import write_sheet
    from test_photo_synthetic import CONDITION, make_manifest, some_design
    from test_verify_run import promise

    claims = [CONDITION | dict(px_per_mm=2.0, contrast=0.7 + 0.01 * i, blur_px=0.5) for i in range(4)]
    settings = {
        "printer": {"profile": "identity"},
        "camera": {"photo_px": [640, 480], "noise": [0.0, 0.01]},
        "target": {"label": "bright", "accept": []},
        "sheet": {"template": "a4"},
    }
    control = dict(rate=0.1, interval=[0.0, 0.2], confidence=0.1, difference=0.8, difference_interval=[0.7, 0.9])
    promised = promise(claims) | {"controls": {"gray": control}}
    piece = lay_out_piece((300.0, 300.0), 20.0, "FUZZFUZZ00", "design")
    with tempfile.TemporaryDirectory() as folder:
        content = PrintedPiece(piece, "FUZZFUZZ00", "design", some_design(), settings=settings)
        tiled = write_sheet(Path(folder) / "a.pdf", load_template("a4_tiles"), content)
    own = json.loads(dump_manifest(make_manifest(promised)))
    return [own | {"settings": settings}, json.loads(dump_manifest(tiled))]


@functools.cache
def honest_photo() -> bytes:
    """A photograph of the first manifest's sheet that is measured."""
    from test_photo_synthetic import make_manifest, page_raster, photograph, view

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
    from patchproof.evidence.run import gather_evidence
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
        run.optimize_scene(toml(folder / "scene.toml", optimize__steps=1), folder / "run", controls=("bare",))
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
    from patchproof.optimizer.checkpoint import CHECKPOINT, resumed

    data, problem = (finished_run() / CHECKPOINT).read_bytes(), small_problem()
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
    (folder / CHECKPOINT).write_bytes(data)
    return lambda: resumed(folder, problem)


def other_tensors(rng: Rng, folder: Path) -> Read:
    """A checkpoint with whole tensors of other shapes, types and values."""
    from patchproof.optimizer.checkpoint import CHECKPOINT, resumed

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
    (folder / CHECKPOINT).write_bytes(safetensors_bytes(tensors, {"state": json.dumps(note)}))
    return lambda: resumed(folder, problem)


PLACE = {
    "sheet_id": "ABCDEFGHIJ",
    "front": "+z",
    "at": [1.0, 2.0, 3.0],
    "spin_deg": 0.0,
    "lead": {"value": 0.1, "interval": [0.0, 0.2], "sure": False},
    "passes": 10,
    "run_share": 0.2,
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
    "tone_light": [0.0, 0.1, 0.2, 0.5, 1.0],
}


def place_json(rng: Rng, folder: Path) -> Read:
    from patchproof.optimizer.place_files import read_place

    (folder / "place.json").write_bytes(broken_json(rng, PLACE))
    return lambda: read_place(folder)


def camera_json(rng: Rng, folder: Path) -> Read:
    from patchproof.channel.lens import load_camera, pinhole_frame, undistort_points

    (folder / "camera.json").write_bytes(broken_json(rng, CAMERA))

    def read() -> None:
        camera = load_camera(str(folder / "camera.json"))
        pinhole_frame(camera, (400, 300))
        undistort_points(np.array([[10.0, 10.0]]), camera, (400, 300))

    return read


def printer(rng: Rng, folder: Path) -> Read:
    from patchproof.channel.printer import SIZE, load_printer
    from patchproof.strict import shipped

    source = shipped("calibration", "printers")
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
    return lambda: bake(folder / "p.icc", "p", "CC0", "test", bool(rng.random() < 0.5))


# --- text ---

FACES = "0\n2-5\n# a comment\n7 # eight\n"
LABELS = 'a.png,jeep\nb.png,"cat, tabby"\nc.png,3\n'
CARD = {"input_px": 16, "labels": ["a", "b", "c"]}


def labels_csv(rng: Rng, folder: Path) -> Read:
    from patchproof.harden.labeled import labeled_files
    from patchproof.scene.image_scene import labels_of

    (folder / "labels.csv").write_bytes(broken_lines(rng, LABELS))
    for name in "abc":
        Image.new("RGB", (4, 4)).save(folder / f"{name}.png")
    return lambda: (labels_of(folder, folder / "labels.csv"), labeled_files(folder, folder / "labels.csv"))


def faces_txt(rng: Rng, folder: Path) -> Read:
    from patchproof.scene.texture import _read_faces

    (folder / "faces.txt").write_bytes(broken_lines(rng, FACES))
    return lambda: _read_faces(folder / "faces.txt", 12)


def card_json(rng: Rng, folder: Path) -> Read:
    from patchproof.classifier.program import load_program

    (folder / "n.pt2").write_bytes(b"PK")
    (folder / "n.json").write_bytes(broken_json(rng, CARD))
    return lambda: load_program(folder / "n.pt2")


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
    from patchproof.scene.backgrounds import load_backgrounds
    from patchproof.scene.texture import _read_mask
    from patchproof.settings import BackgroundSettings

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
    from patchproof.printing.sheet import blank_page
    from patchproof.sheets.piece import lay_out_piece
    from patchproof.sheets.template import load_template
    from patchproof.sheets.tiles import refuse_larger_than_page
    from patchproof.strict import shipped

    name = str(rng.choice(TEMPLATES))
    text = shipped("print_templates", f"{name}.toml").read_text(encoding="utf-8")
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
        if part == "nodes" and rng.random() < 0.6:
            tree["nodes"][int(rng.integers(len(tree["nodes"])))]["children"] = rng.integers(
                0, len(tree["nodes"]), 2
            ).tolist()
        elif part == "accessors" and rng.random() < 0.6:
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

    from patchproof.sheets.raster import attached_manifest, page_pixels
    from patchproof.sheets.shop import shop_lines

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
    reads = [lambda: attached_manifest(path), lambda: shop_lines(path), lambda: page_pixels(path, 1, 20.0)]
    return reads[rng.integers(3)]


def long_path(rng: Rng, folder: Path) -> Read:
    """Names that no system takes, wherever a path is."""
    import patchproof as pp
    from patchproof.calibrate.icc import bake
    from patchproof.channel.lens import load_camera
    from patchproof.channel.printer import load_printer
    from patchproof.mesh.load_mesh import load_mesh
    from patchproof.photo.read import list_photos
    from patchproof.scene.image_scene import label_rows
    from patchproof.sheets.manifest import load_manifest
    from patchproof.sheets.raster import attached_manifest, page_pixels

    name = str(rng.choice(["x" * 300, "a\0b", "d/" * 2500, "ä" * 200, "\udcff" * 200, "."]))
    readers = [load_manifest, list_photos, attached_manifest, page_pixels, label_rows, pp.load_run, pp.load_scene]
    readers += [
        lambda p: load_printer(f"{p}.npz"),
        lambda p: load_camera(f"{p}.json"),
        lambda p: load_mesh(f"{p}.obj", 1.0),
    ]
    readers += [lambda p: bake(p, "p", "", ""), lambda p: pp.verify(folder, folder / "no.json", p)]
    reader = readers[rng.integers(len(readers))]
    return lambda: reader(folder / name)


# name: (what makes it, how many of a hundred inputs)
READERS: dict[str, tuple[Callable[[Rng, Path], Read], int]] = {
    "photo": (photo, 30),
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


class Watch:
    """Files opened for writing outside of a folder, processes, sockets; a hook stays for good, so it has a switch."""

    WRITES = re.compile(r"os\.(mkdir|rename|remove|rmdir|link|symlink|truncate|chmod|chown|utime)|shutil\.")
    NEVER = re.compile(
        r"os\.(system|exec|posix_spawn|spawn|fork|startfile)|subprocess\.|socket\.|pty\.|ctypes\.dlopen\b"
    )

    def __init__(self):
        self.folder: str | None = None
        self.events: list[str] = []
        sys.addaudithook(self.hook)

    def hook(self, event: str, arguments: tuple) -> None:
        if self.folder is not None and self.harmful(event, arguments):
            self.events.append(f"{event} {str(arguments)[:200]}")

    def harmful(self, event: str, arguments: tuple) -> bool:
        if event == "open":
            path, mode, flags = arguments
            writes = re.search("[wax+]", mode) if mode else (flags or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            return bool(writes) and not isinstance(path, int) and not self.inside(path)
        if self.WRITES.match(event):
            return not self.inside(arguments[0])
        return bool(self.NEVER.match(event))

    def inside(self, path) -> bool:
        text = os.fsdecode(path) if isinstance(path, str | bytes | os.PathLike) else ""
        own = os.path.abspath(text).startswith(self.folder or "")
        return own or text.startswith(("/dev/null", "/proc/self")) or "__pycache__" in text

    @contextlib.contextmanager
    def on(self, folder: Path):
        self.folder, self.events = str(folder.resolve()), []
        try:
            yield
        finally:
            self.folder = None


class TooLong(BaseException):
    """The processor time of one input is over."""


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
        if watch.events:
            how = f"did {watch.events[:3]}"
        return Outcome(reader, seed, how, time.process_time() - begin, max(0, peak_bytes() - before))


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


@contextlib.contextmanager
def temporary_files_in(folder: str):
    before, tempfile.tempdir = tempfile.tempdir, folder
    try:
        yield
    finally:
        tempfile.tempdir = before


@contextlib.contextmanager
def limits():
    """Processor time and memory that one input may take."""

    def over(*_):
        raise TooLong(f"more than {SECONDS:g} s of processor time")

    try:
        import resource
    except ImportError:  # on Windows
        yield
        return
    before = signal.signal(signal.SIGVTALRM, over)
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    statm = Path("/proc/self/statm")
    try:
        if statm.is_file():
            now = int(statm.read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (now + MOST_BYTES, hard))
        signal.setitimer(signal.ITIMER_VIRTUAL, SECONDS)
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
        signal.signal(signal.SIGVTALRM, before)


def peak_bytes(reset: bool = False) -> int:
    """The most memory that this process has held since the last reset, where the system says so."""
    try:
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        match = re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())
    except OSError:
        return 0
    return int(match[1]) * 1024 if match else 0
