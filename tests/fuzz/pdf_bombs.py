"""PDFs of a few kilobytes that ask for gigabytes or for hours."""

from __future__ import annotations

import zlib
from collections.abc import Callable

Objects = dict[int, tuple[bytes, bytes | None]]  # by number: the dictionary and the stream
PAGE = b"<</Type/Page/Parent 2 0 R/MediaBox[0 0 200 200]/Contents 4 0 R/Resources %s>>"
TWICE = b"/Filter[/FlateDecode/FlateDecode]"
BYTES = 3 << 30


def zeros(count: int) -> bytes:
    """Zeros in whole blocks of 16 MiB, compressed to a thousandth: a block's bytes are repeated."""
    packer, blocks = zlib.compressobj(9, zlib.DEFLATED, -15), -(-count >> 24)
    block = packer.compress(bytes(1 << 24)) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = ((blocks << 24) % 65521 << 16 | 1).to_bytes(4, "big")
    return b"\x78\xda" + block * blocks + b"\x03\0" + checksum


def twice(count: int) -> bytes:
    return zlib.compress(zeros(count), 9)


def written(objects: Objects, places: dict[int, int] | None = None) -> bytes:
    """The body of a file; the places of its objects are added to `places`."""
    out = b"%PDF-1.7\n"
    for number, (table, stream) in objects.items():
        if places is not None:
            places[number] = len(out)
        body = b"" if stream is None else b"\nstream\n" + stream + b"\nendstream"
        out += b"%d 0 obj\n%s%s\nendobj\n" % (number, table, body)
    return out


def with_page(resources: bytes, contents: bytes, extra: Objects, table: bytes = b"") -> bytes:
    objects: Objects = {
        1: (b"<</Type/Catalog/Pages 2 0 R>>", None),
        2: (b"<</Type/Pages/Kids[3 0 R]/Count 1>>", None),
        3: (PAGE % resources, None),
        4: (b"<<%s/Length %d>>" % (table, len(contents)), contents),
        **extra,
    }
    return written(objects) + b"trailer<</Root 1 0 R/Size 99>>\n%%EOF"


def object_stream() -> bytes:
    """An object stream that is compressed twice: 3 GB in 5 kB."""
    data, places = twice(BYTES), dict[int, int]()
    body = written(
        {
            1: (b"<</Type/Catalog/Pages 2 0 R>>", None),
            2: (b"<</Type/Pages/Kids[3 0 R]/Count 1>>", None),
            3: (PAGE % b"5 0 R", None),
            4: (b"<</Length 1>>", b" "),
            6: (b"<</Type/ObjStm/N 1/First 5%s/Length %d>>" % (TWICE, len(data)), data),
        },
        places,
    )
    places[7] = len(body)
    rows = b"".join(
        b"\x02\0\0\0\x06\0\0" if n == 5 else b"\x01" + places.get(n, 0).to_bytes(4, "big") + b"\0\0" for n in range(8)
    )
    head = b"<</Type/XRef/Size 8/W[1 4 2]/Root 1 0 R/Length %d>>" % len(rows)
    return body + b"7 0 obj\n%s\nstream\n%s\nendstream\nendobj\nstartxref\n%d\n%%%%EOF" % (head, rows, len(body))


def contents() -> bytes:
    return with_page(b"<<>>", twice(BYTES), {}, TWICE)


def image(size: int, filters: bytes, data: bytes, bits: bytes = b"/BitsPerComponent 8/ColorSpace/DeviceRGB") -> bytes:
    table = b"<</Type/XObject/Subtype/Image/Width %d/Height %d%s%s/Length %d>>" % (size, size, bits, filters, len(data))
    return with_page(b"<</XObject<</I 5 0 R>>>>", b"200 0 0 200 0 0 cm /I Do", {5: (table, data)})


def run_lengths() -> bytes:
    """Runs of 128 bytes, compressed twice."""
    data = zlib.compress(zlib.compress(b"\x81\0" * (1 << 23) + b"\x80", 9), 9)
    return image(30_000, b"/Filter[/FlateDecode/FlateDecode/RunLengthDecode]", data)


def jbig2() -> bytes:
    """A page of 65,535 × 65,535 pixels in a JBIG2 segment."""
    side = (65_535).to_bytes(4, "big")
    return image(
        65_535, b"/Filter/JBIG2Decode", bytes(4) + b"\x30\0\1" + (19).to_bytes(4, "big") + 2 * side + bytes(11)
    )


def forms() -> bytes:
    """Forms in forms: a rectangle that is drawn ten thousand million times."""
    head = b"<</Type/XObject/Subtype/Form/BBox[0 0 200 200]/Resources<</XObject<</F %d 0 R>>>>/Length %d>>"
    extra: Objects = {n: (head % (n + 1, 60), b"/F Do " * 10) for n in range(5, 15)}
    extra[15] = (b"<</Type/XObject/Subtype/Form/BBox[0 0 200 200]/Length 12>>", b"1 1 9 9 re f")
    return with_page(b"<</XObject<</F 5 0 R>>>>", b"/F Do", extra)


def pattern() -> bytes:
    """A tiling of a thousandth of a point."""
    head = b"<</Type/Pattern/PatternType 1/PaintType 1/TilingType 1/BBox[0 0 9 9]/XStep .001/YStep .001/Resources<<>>"
    extra: Objects = {5: (head + b"/Length 12>>", b"0 0 9 9 re f")}
    return with_page(b"<</Pattern<</P 5 0 R>>>>", b"/Pattern cs /P scn 0 0 200 200 re f", extra)


def attachment() -> bytes:
    """A manifest of 3 GB, in streams that are compressed once, or twice."""
    data = zeros(BYTES)
    objects: Objects = {
        1: (b"<</Type/Catalog/Pages 2 0 R/Names<</EmbeddedFiles<</Names[(sheet.json) 5 0 R]>>>>>>", None),
        2: (b"<</Type/Pages/Kids[3 0 R]/Count 1>>", None),
        3: (PAGE % b"<<>>", None),
        4: (b"<</Length 1>>", b" "),
        5: (b"<</Type/Filespec/F(sheet.json)/UF(sheet.json)/EF<</F 6 0 R>>>>", None),
        6: (b"<</Type/EmbeddedFile/Filter/FlateDecode/Length %d>>" % len(data), data),
    }
    return written(objects) + b"trailer<</Root 1 0 R/Size 7>>\n%%EOF"


def page_tree_in_a_circle() -> bytes:
    objects: Objects = {1: (b"<</Type/Catalog/Pages 2 0 R>>", None), 2: (b"<</Type/Pages/Kids[2 0 R]/Count 9>>", None)}
    return written(objects) + b"trailer<</Root 1 0 R/Size 3>>\n%%EOF"


def many_pages() -> bytes:
    kids = b" ".join([b"3 0 R"] * 200_000)
    objects: Objects = {
        1: (b"<</Type/Catalog/Pages 2 0 R>>", None),
        2: (b"<</Type/Pages/Kids[%s]/Count 200000>>" % kids, None),
        3: (PAGE % b"<<>>", None),
        4: (b"<</Length 1>>", b" "),
    }
    return written(objects) + b"trailer<</Root 1 0 R/Size 5>>\n%%EOF"


def nested_arrays() -> bytes:
    return with_page(b"<</X " + b"[" * 200_000 + b"]" * 200_000 + b">>", b" ", {})


PDF_BOMBS: dict[str, Callable[[], bytes]] = {
    "object stream": object_stream,
    "contents": contents,
    "flate image": lambda: image(30_000, TWICE, twice(BYTES)),
    "bits": lambda: image(60_000, TWICE, twice(450_000_000), b"/BitsPerComponent 1/ColorSpace/DeviceGray"),
    "run lengths": run_lengths,
    "lzw": lambda: image(30_000, b"/Filter[/FlateDecode/LZWDecode]", zeros(1 << 28)),
    "jbig2": jbig2,
    "forms": forms,
    "pattern": pattern,
    "attachment": attachment,
    "page tree": page_tree_in_a_circle,
    "many pages": many_pages,
    "nested arrays": nested_arrays,
}
