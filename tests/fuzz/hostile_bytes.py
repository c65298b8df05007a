"""Bytes of files, honest ones with something changed in them and dishonest ones, each by a generator's draws.

Changes of bytes, of JSON values and of lines of text; pictures of every kind, and such as take much to read.
"""

from __future__ import annotations

import copy
import io
import json
import re
import struct
import zlib
from collections.abc import Iterator

import numpy as np
from PIL import Image

Rng = np.random.Generator

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


def whole_photo(rng: Rng, kind, size: tuple[int, int] = (32, 24)) -> bytes:
    """A valid picture of a kind, and of a size as wide and high: noise of 32×24, black around it."""
    mode, file_format, options = kind
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    pixels[:24, :32] = rng.integers(0, 256, (24, 32, 3), np.uint8)[: size[1], : size[0]]
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
    data, how = bytearray(data or b"\0"), rng.integers(6)
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
