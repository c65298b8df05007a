"""Each declaration in `photo/declarations.csv` has a file here, and is used, refused or said as the list says.

Files are made by hand or by Pillow; colors are computed from chromaticities and curves, in float64 and not by our code.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageChops, ImageCms
from PIL.TiffImagePlugin import OPEN_INFO

from patchproof.base.declarations import load_declarations
from patchproof.photo import color_space, read
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected

D65, ACES = (0.3127, 0.329), (0.32168, 0.33767)
SRGB, P3 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06), (0.68, 0.32, 0.265, 0.69, 0.15, 0.06)
ADOBE, BT2020 = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06), (0.708, 0.292, 0.17, 0.797, 0.131, 0.046)
COLORS = np.array([(90, 150, 80), (200, 120, 100), (30, 40, 60), (128, 128, 128), (250, 240, 230), (9, 12, 8)])
PIXELS = np.kron(COLORS.reshape(2, 3, 3), np.ones((8, 8, 1))).astype(np.uint8)
GRAY = PIXELS[..., 1]
PIXELS_IN_PLANES = (np.moveaxis(PIXELS, -1, 0).astype(np.uint16) * 257).reshape(PIXELS.shape)
RIGHT_IF_SRGB = PIXELS[::8, ::8].astype(float)


def srgb_light(codes):
    codes = np.asarray(codes, float)
    return np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)


def srgb_code(light):
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0) ** (1 / 2.4) - 0.055)


def xyz(primaries, white=D65):
    """Linear RGB to XYZ at its own white."""
    columns = [[x / y, 1, (1 - x - y) / y] for x, y in (primaries[:2], primaries[2:4], primaries[4:], white)]
    matrix = np.array(columns[:3]).T
    return matrix * np.linalg.inv(matrix).dot(columns[3])


def expected(codes, primaries=SRGB, curve=srgb_light, white=D65):
    """8-bit sRGB of codes in 0 to 1, adapted to D65 by Bradford's matrix."""
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    whites = [bradford @ [x / y, 1, (1 - x - y) / y] for x, y in (D65, white)]
    adapt = np.linalg.inv(bradford) @ np.diag(whites[0] / whites[1]) @ bradford
    light = curve(np.asarray(codes, float)) @ (np.linalg.inv(xyz(SRGB)) @ adapt @ xyz(primaries, white)).T
    return 255 * np.clip(srgb_code(light), 0, 1)


def profile(primaries, gamma: float, space: bytes = b"RGB ", description: str = "sRGB IEC61966-2.1") -> bytes:
    """An ICC profile of version 2 by hand, under any name."""
    d50 = np.array([0.9642, 1, 0.8249])
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    own = xyz(primaries)
    adapt = np.linalg.inv(bradford) @ np.diag(bradford @ d50 / (bradford @ own.sum(1))) @ bradford

    def numbers(values) -> bytes:
        return b"XYZ \0\0\0\0" + struct.pack(">3i", *(round(v * 65536) for v in values))

    name = description.encode() + b"\0"
    tags = {b"desc": b"desc\0\0\0\0" + struct.pack(">I", len(name)) + name + bytes(78), b"wtpt": numbers(d50)}
    curve = b"curv\0\0\0\0" + struct.pack(">IHH", 1, round(gamma * 256), 0)
    if space == b"RGB ":
        tags |= {tag + b"XYZ": numbers(column) for tag, column in zip((b"r", b"g", b"b"), (adapt @ own).T, strict=True)}
    tags |= {name + b"TRC": curve for name in ((b"r", b"g", b"b") if space == b"RGB " else (b"k",))}
    table, body = b"", b""
    for tag, content in tags.items():
        table += tag + struct.pack(">II", 132 + 12 * len(tags) + len(body), len(content))
        body += content + bytes(-len(content) % 4)
    size = 132 + len(table) + len(body)
    head = struct.pack(">I4sI4s4s4s12s4s", size, b"none", 0x02100000, b"mntr", space, b"XYZ ", bytes(12), b"acsp")
    head = (head + bytes(28) + struct.pack(">3i", *(round(v * 65536) for v in d50))).ljust(128, b"\0")
    return head + struct.pack(">I", len(tags)) + table + body


def png(*chunks: tuple[bytes, bytes], pixels: np.ndarray = PIXELS) -> bytes:
    """A PNG by hand with these chunks before its pixels."""
    pixels = np.ascontiguousarray(pixels)
    height, width = pixels.shape[:2]
    kind = {(2, 1): 0, (3, 3): 2}[pixels.ndim, pixels.shape[-1] if pixels.ndim == 3 else 1]
    head = struct.pack(">IIBBBBB", width, height, 8 * pixels.itemsize, kind, 0, 0, 0)
    rows = pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()
    stride = len(rows) // height
    data = zlib.compress(b"".join(b"\0" + rows[i : i + stride] for i in range(0, len(rows), stride)))
    parts = ((b"IHDR", head), *chunks, (b"IDAT", data), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))
        for name, content in parts
    )


def chrm(primaries, white=D65) -> tuple[bytes, bytes]:
    return b"cHRM", struct.pack(">8I", *(round(1e5 * v) for v in (*white, *primaries)))


def gama(exponent: float) -> tuple[bytes, bytes]:
    return b"gAMA", struct.pack(">I", round(1e5 / exponent))


def tiff(pixels: np.ndarray, tags: dict[int, list[int]] | None = None, bits: int = 0) -> bytes:
    """A TIFF by hand, little endian, in one strip; `tags` are of 16 bits."""
    height, width = pixels.shape[:2]
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    data = pixels.tobytes()
    if bits == 12:
        pairs = pixels.reshape(-1, 2).astype(int)
        data = np.stack([pairs[:, 0] >> 4, (pairs[:, 0] & 15) << 4 | pairs[:, 1] >> 8, pairs[:, 1] & 255], 1)
        data = data.astype(np.uint8).tobytes()
    kind = {"f": 3, "i": 2}.get(pixels.dtype.kind, 1)
    entries = {256: [width], 257: [height], 258: [bits or 8 * pixels.itemsize] * channels, 259: [1]}
    entries |= {262: [2 if channels > 2 else 1], 273: [8], 277: [channels], 278: [height], 339: [kind] * channels}
    entries |= {279: [len(data)]} | (tags or {})
    start = 8 + len(data) + len(data) % 2
    more, table = b"", struct.pack("<H", len(entries))
    for tag, values in sorted(entries.items()):
        content = struct.pack(f"<{len(values)}H", *values)
        if len(content) > 4:
            more, content = more + content, struct.pack("<I", start + 6 + 12 * len(entries) + len(more))
        table += struct.pack("<HHI", tag, 3, len(values)) + content.ljust(4, b"\0")
    return b"II*\0" + struct.pack("<I", start) + data + bytes(len(data) % 2) + table + bytes(4) + more


def saved(pixels: np.ndarray | Image.Image, kind: str, **options) -> bytes:
    buffer = io.BytesIO()
    (pixels if isinstance(pixels, Image.Image) else Image.fromarray(pixels)).save(buffer, kind, **options)
    return buffer.getvalue()


def without_second_part(jpeg: bytes) -> bytes:
    """A JPEG without the second part of its ICC profile."""
    start = jpeg.index(b"ICC_PROFILE\0\2") - 4
    return jpeg[:start] + jpeg[start + 2 + int.from_bytes(jpeg[start + 2 : start + 4]) :]


def exif(space: int | None = None, interop: str | None = None, orientation: int | None = None, **tags) -> Image.Exif:
    data = Image.Exif()
    for tag, value in ((0x0112, orientation), (318, tags.get("white")), (319, tags.get("primaries"))):
        if value is not None:
            data[tag] = value
    details = data.get_ifd(0x8769)
    if "focal" in tags:
        details[0xA405] = tags["focal"]
    if space is not None:
        details[0xA001] = space
    if interop is not None:
        details[0xA005] = {1: interop}
    return data


@pytest.fixture
def reading(tmp_path) -> Callable:
    def read_bytes(content: bytes, suffix: str = "png"):
        path: Path = tmp_path / f"a.{suffix}"
        path.write_bytes(content)
        return read_photo(path)

    return read_bytes


def colors_of(photo) -> np.ndarray:
    """The mean of each of six squares."""
    return photo.srgb.reshape(2, 8, 3, 8, 3).mean((1, 3))


TURNED = exif(orientation=6)
XMP = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description tiff:Orientation="%d"/></x:xmpmeta>'
PALETTE = Image.fromarray(PIXELS).quantize(6, dither=0)
CMYK = Image.fromarray(PIXELS).convert("CMYK")
ALPHA = np.dstack([PIXELS, np.full(GRAY.shape, 255, np.uint8)])
HALF = np.dstack([PIXELS, np.full(GRAY.shape, 128, np.uint8)])
ON_WHITE = PIXELS * (128 / 255) + 255 * (127 / 255)
HALF_GRAY = np.repeat((GRAY // 2 + 127.0)[::8, ::8, None], 3, 2)
GAMMA18 = profile(P3, 1.8)
AS_P3 = expected(RIGHT_IF_SRGB / 255, P3)
AS_GAMMA18 = expected(RIGHT_IF_SRGB / 255, P3, lambda codes: codes ** (461 / 256))
AS_ADOBE = expected(RIGHT_IF_SRGB / 255, ADOBE, lambda codes: codes ** (563 / 256))
GRAY_RIGHT = np.repeat(RIGHT_IF_SRGB[..., 1:2], 3, 2)
AS_GRAY18 = 255 * srgb_code((GRAY_RIGHT / 255) ** (461 / 256))
WIDE = np.kron(np.arange(6).reshape(2, 3) * 700 + 595, np.ones((8, 8))).astype(np.uint16)  # up to 4,095
AS_WIDE = np.repeat(WIDE[::8, ::8, None] * (255 / 4095), 3, 2)
LIGHT = np.float32(srgb_light(GRAY / 255))


def unmarked(content: bytes) -> bytes:
    """A JPEG without JFIF's and Adobe's markers."""
    for marker in (b"\xff\xee", b"\xff\xe0"):
        at = content.find(marker, 0, 400)
        if at > 0:
            content = content[:at] + content[at + 2 + int.from_bytes(content[at + 2 : at + 4]) :]
    return content


def odd_headers() -> list[Callable[[bytes], bytes]]:
    """Headers of which libjpeg warns, and of nothing after them: a later JFIF, parameters of the scan."""

    def with_parameters(content: bytes) -> bytes:
        end = content.index(b"\xff\xda") + 2 + 12
        return content[: end - 2] + b"\0" + content[end - 1 :]

    return [lambda content: content.replace(b"JFIF\0\1", b"JFIF\0\2"), with_parameters]


def noise_jpeg(**options) -> bytes:
    return saved(np.random.default_rng(0).integers(0, 256, (128, 128, 3), np.uint8), "JPEG", **options)


def zeroed(content: bytes, size: int = 900) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes(size) + content[middle + size :]


def nclx(primaries: int, transfer: int) -> bytes:
    content, box = saved(PIXELS, "AVIF", quality=100, subsampling="4:4:4"), b"colrnclx"
    at = content.find(box) + len(box)
    return content[:at] + struct.pack(">HH", primaries, transfer) + content[at + 4 :]


def bmp_v4() -> bytes:
    plain = saved(PIXELS, "BMP")
    head = struct.pack("<I", 108) + plain[18:54] + bytes(16) + struct.pack("<I", 0) + bytes(48)
    return plain[:10] + struct.pack("<I", 14 + 108) + head + plain[54:]


def pages(kind: str) -> bytes:
    return saved(PIXELS, kind, save_all=True, append_images=[Image.fromarray(PIXELS[::-1].copy())])


def with_preview() -> bytes:
    """Two pictures in a file, of which the second is declared to be a large thumbnail."""
    content = pages("MPO")
    second = content.find(b"\0\0\x03\0", content.find(b"MPF\0")) + 16
    return content[:second] + b"\x02\0\x01\0" + content[second + 4 :]


def ink_profile() -> bytes:
    """A CMYK profile by hand, in which only black prints: L* is 100 times what K leaves."""
    grid = bytes(value for k in np.tile([255, 0], 8).tolist() for value in (k, 128, 128))
    ramp = bytes(range(256))
    lut = b"mft1" + bytes(4) + bytes([4, 3, 2, 0]) + struct.pack(">9i", *(np.eye(3, dtype=int) * 65536).ravel())
    lut += ramp * 4 + grid + ramp * 3
    white = b"XYZ \0\0\0\0" + struct.pack(">3i", 63190, 65536, 54061)
    table = struct.pack(">I4sII4sII", 2, b"wtpt", 156, 20, b"A2B0", 176, len(lut))
    head = struct.pack(
        ">I4sI4s4s4s12s4s", 176 + len(lut), b"none", 0x02100000, b"prtr", b"CMYK", b"Lab ", bytes(12), b"acsp"
    )
    return (head + bytes(28) + struct.pack(">3i", 63190, 65536, 54061)).ljust(128, b"\0") + table + white + lut


BLACK = np.kron(np.array([[0, 255, 102], [51, 153, 204]]), np.ones((8, 8))).astype(np.uint8)
INKS = np.dstack([np.full_like(BLACK, 255), BLACK, np.full_like(BLACK, 90), BLACK])
_L_STAR = 100 - BLACK[::8, ::8] / 2.55
AS_BLACK = 255 * srgb_code(np.where(_L_STAR > 8, ((_L_STAR + 16) / 116) ** 3, _L_STAR / 903.3))[..., None].repeat(3, 2)
LAB = ImageCms.applyTransform(
    Image.fromarray(PIXELS),
    ImageCms.buildTransform(ImageCms.createProfile("sRGB"), ImageCms.createProfile("LAB"), "RGB", "LAB"),
)
# by what is declared: files (content, suffix), and the right colors, or a part of what is said, or "unreadable"
CASES: dict[str, list[tuple[bytes, str, object]]] = {
    "orientation in EXIF": [
        (saved(np.rot90(PIXELS).copy(), kind, exif=TURNED, **options), kind.lower(), RIGHT_IF_SRGB)
        for kind, options in (("PNG", {}), ("WEBP", {"lossless": True}), ("JPEG", {"quality": 100, "subsampling": 0}))
    ],
    "orientation in XMP": [
        (saved(np.rot90(PIXELS).copy(), "JPEG", quality=100, subsampling=0, xmp=XMP % 6), "jpg", RIGHT_IF_SRGB)
    ],
    "orientations in EXIF and XMP that differ": [
        (saved(PIXELS, "JPEG", exif=exif(orientation=1), xmp=XMP % 6), "jpg", read.TWO_ORIENTATIONS)
    ],
    "orientation (tag 274)": [
        (tiff(np.rot90(PIXELS).copy(), {274: [6]}), "tif", RIGHT_IF_SRGB),
        (tiff((np.rot90(PIXELS).astype(np.uint16) * 257).copy(), {274: [6]}), "tif", RIGHT_IF_SRGB),
        (tiff(np.rot90(GRAY).copy(), {274: [6]}), "tif", GRAY_RIGHT),
    ],
    "irot and imir": [
        (saved(PIXELS, "AVIF", xmp=XMP % 6, quality=100, subsampling="4:4:4"), "avif", RIGHT_IF_SRGB),
        (saved(np.rot90(PIXELS).copy(), "AVIF", exif=TURNED, quality=100, subsampling="4:4:4"), "avif", RIGHT_IF_SRGB),
    ],
    "ICC profile of RGB": [
        (saved(image, kind, icc_profile=GAMMA18, **options), kind.lower(), AS_GAMMA18)
        for image, kind, options in (
            *((PIXELS, kind, {}) for kind in ("PNG", "TIFF")),
            (PIXELS, "JPEG", {"quality": 100, "subsampling": 0}),
            (PIXELS, "WEBP", {"lossless": True}),
            (PALETTE, "PNG", {}),
            (ALPHA, "PNG", {}),
        )
    ]
    + [(png((b"iCCP", b"x\0\0" + zlib.compress(GAMMA18)), pixels=PIXELS.astype(np.uint16) * 257), "png", AS_GAMMA18)],
    "ICC profile of gray": [
        (saved(GRAY, "JPEG", quality=100, icc_profile=profile(SRGB, 1.8, b"GRAY")), "jpg", AS_GRAY18),
        *(
            (saved(image, "PNG", icc_profile=profile(SRGB, 1.8, b"GRAY")), "png", AS_GRAY18)
            for image in (GRAY, np.dstack([GRAY, np.full_like(GRAY, 255)]), GRAY.astype(np.uint16) * 257)
        ),
    ],
    "ICC profile named sRGB that is another": [(saved(PIXELS, "PNG", icc_profile=GAMMA18), "png", AS_GAMMA18)],
    "ICC profile that is broken, or of another kind of picture": [
        (saved(PIXELS, "PNG", icc_profile=content), "png", color_space.BROKEN_PROFILE)
        for content in (GAMMA18[:90], b"x" * 300, profile(SRGB, 1.8, b"GRAY"))
    ]
    + [
        (
            without_second_part(saved(PIXELS, "JPEG", icc_profile=GAMMA18 + bytes(70_000))),
            "jpg",
            color_space.BROKEN_PROFILE,
        )
    ],
    "CMYK without a profile": [(saved(CMYK, kind), kind.lower(), color_space.BARE_INKS) for kind in ("JPEG", "TIFF")],
    "ICC profile of CMYK": [
        (
            saved(Image.frombytes("CMYK", (24, 16), INKS.tobytes()), kind, icc_profile=ink_profile(), **options),
            kind.lower(),
            AS_BLACK,
        )
        for kind, options in (("TIFF", {}), ("JPEG", {"quality": 100}))
    ],
    "CIELAB": [(saved(LAB, "TIFF"), "tif", lambda photo: np.abs(colors_of(photo) - RIGHT_IF_SRGB).max() < 5)],
    "Adobe's marker: inverted CMYK and YCCK": [(saved(CMYK, "JPEG", quality=100), "jpg", RIGHT_IF_SRGB)],
    "CMYK without Adobe's marker": [
        (unmarked(saved(ImageChops.invert(CMYK), "JPEG", quality=100)), "jpg", RIGHT_IF_SRGB)
    ],
    "Adobe RGB in EXIF": [
        (saved(PIXELS, "JPEG", quality=100, subsampling=0, exif=exif(65535, "R03")), "jpg", AS_ADOBE),
        (saved(PIXELS, "WEBP", lossless=True, exif=exif(2)), "webp", AS_ADOBE),
    ],
    "Adobe RGB (R03) beside sRGB in EXIF": [
        (saved(PIXELS, "JPEG", exif=exif(1, "R03")), "jpg", color_space.CONTRADICTION)
    ],
    "ColorSpace 65535 in EXIF without R03 or a profile": [
        (saved(PIXELS, "JPEG", exif=exif(65535, "R98")), "jpg", color_space.UNNAMED_SPACE)
    ],
    "primaries, white and gamma in EXIF or TIFF (tags 318, 319)": [
        (saved(PIXELS, "JPEG", quality=100, subsampling=0, exif=exif(primaries=P3, white=D65)), "jpg", AS_P3)
    ],
    "cICP": [
        (png((b"cICP", bytes([12, 13, 0, 1])), (b"sRGB", b"\0"), chrm(SRGB), gama(2.2)), "png", AS_P3),
        (png((b"cICP", bytes([9, 13, 0, 1]))), "png", expected(RIGHT_IF_SRGB / 255, BT2020)),
    ],
    "sRGB": [(png((b"sRGB", b"\0"), chrm(P3), gama(1.8)), "png", RIGHT_IF_SRGB)],
    "cHRM and gAMA": [
        (png(chrm(ADOBE, ACES), gama(1.8)), "png", expected(RIGHT_IF_SRGB / 255, ADOBE, lambda c: c**1.8, ACES)),
        (png(gama(1.0)), "png", expected(RIGHT_IF_SRGB / 255, curve=lambda c: c)),
        (png(gama(1.0), pixels=GRAY.astype(np.uint16) * 257), "png", expected(GRAY_RIGHT / 255, curve=lambda c: c)),
    ],
    "cHRM or gAMA that no screen has": [
        (png(chunk), "png", color_space.BROKEN_PRIMARIES) for chunk in (chrm((0,) * 6), (b"gAMA", bytes(4)))
    ],
    "PQ or HLG (cICP, nclx)": [
        *((png((b"cICP", bytes([9, transfer, 0, 1]))), "png", "unreadable") for transfer in (16, 18)),
        (nclx(9, 16), "avif", "unreadable"),
    ],
    "nclx": [(nclx(12, 13), "avif", AS_P3)],
    "a calibrated or embedded color space": [(bmp_v4(), "bmp", color_space.BMP_SPACE)],
    "RGB without JFIF or Adobe's marker": [
        (unmarked(saved(PIXELS, "JPEG", quality=100, keep_rgb=True)), "jpg", RIGHT_IF_SRGB)
    ],
    "gain map": [(saved(PIXELS, "JPEG", xmp=b'<a hdrgm:Version="1.0"/>'), "jpg", read.GAIN_MAP)],
    "16 bits a channel": [
        (png(pixels=pixels.astype(np.uint16) * 256 + 200), "png", right + (200 - right) / 257)
        for pixels, right in ((PIXELS, RIGHT_IF_SRGB), (GRAY, GRAY_RIGHT))
    ]
    + [(tiff(PIXELS.astype(np.uint16) * 257), "tif", RIGHT_IF_SRGB)],
    "16-bit colors in planes": [
        (tiff(PIXELS_IN_PLANES, {284: [2], 273: [8, 776, 1544], 279: [768] * 3}), "tif", "unreadable"),
    ],
    "12 bits in 12, or 10 to 14 in 16 by MaxSampleValue": [
        (tiff(WIDE, {281: [4095]}), "tif", AS_WIDE),
        (tiff(WIDE, bits=12), "tif", AS_WIDE),
        (tiff(np.dstack([WIDE] * 3), {341: [4095] * 3}), "tif", AS_WIDE),
    ],
    "16 bits of which the upper 2 or more are never used": [
        (content, suffix, color_space.SHALLOW.format(12))
        for content, suffix in (
            (tiff(WIDE), "tif"),
            (png(pixels=WIDE), "png"),
            (png(pixels=np.dstack([WIDE] * 3)), "png"),
        )
    ],
    "floating-point values of one channel": [
        (tiff(LIGHT), "tif", color_space.LINEAR_LIGHT),
        (tiff(LIGHT), "tif", GRAY_RIGHT),
        (tiff(LIGHT * 4), "tif", 255 * srgb_code(srgb_light(GRAY_RIGHT / 255) / max(0.25, LIGHT.max()))),
    ],
    "floating-point RGB, or 64 bits": [
        (tiff(content), "tif", "unreadable") for content in (np.dstack([LIGHT] * 3), LIGHT.astype(np.float64))
    ],
    "WhiteIsZero": [
        (tiff(255 - GRAY, {262: [0]}), "tif", GRAY_RIGHT),
        (tiff((255 - GRAY).astype(np.uint16) * 257, {262: [0]}), "tif", GRAY_RIGHT),
    ],
    "associated alpha (ExtraSamples 1)": [
        (tiff(np.dstack([GRAY // 2] * channels + [np.full_like(GRAY, 128)]), {338: [1]}), "tif", HALF_GRAY)
        for channels in (1, 3)
        if channels == 3 or (b"II", 1, (1,), 1, (8, 8), (1,)) in OPEN_INFO  # Pillow 11 reads no gray with it
    ],
    "other extra channels (ExtraSamples 0)": [(tiff(HALF, {338: [0]}), "tif", read.EXTRA_CHANNELS)],
    "transparency": [
        (saved(HALF, "PNG"), "png", ON_WHITE[::8, ::8]),
        (saved(HALF, "WEBP", lossless=True), "webp", ON_WHITE[::8, ::8]),
        (
            saved(PALETTE, "GIF", transparency=PALETTE.getpixel((0, 0))),
            "gif",
            np.r_[[(255, 255, 255)], COLORS[1:]].reshape(2, 3, 3),
        ),
    ],
    "pages after the first": [
        (pages(kind), kind.lower(), read.MORE_PAGES) for kind in ("TIFF", "GIF", "PNG", "WEBP", "MPO")
    ],
    "previews (large thumbnails)": [(with_preview(), "jpg", lambda photo: not photo.said)],
    "damaged or missing parts": [
        (content, "jpg", "unreadable")
        for whole in (noise_jpeg(), noise_jpeg(progressive=True), noise_jpeg(restart_marker_blocks=8))
        for content in (zeroed(whole), whole[: len(whole) // 2] + whole[len(whole) // 2 + 900 :], whole[:-900])
    ],
    "an end that is missing": [
        (saved(PIXELS, kind, **options)[:-60], kind.lower(), "unreadable")
        for kind, options in (("PNG", {}), ("TIFF", {}), ("WEBP", {"lossless": True}))
    ],
    "35 mm focal length in EXIF": [
        (
            saved(PIXELS, "JPEG", exif=exif(focal=26)),
            "jpg",
            lambda photo: photo.focal_px == pytest.approx(17.3, abs=0.1),
        )
    ],
    "resolution (dpi)": [
        (
            saved(PIXELS, kind, dpi=(300, 150)),
            kind.lower(),
            lambda photo: photo.dpi == pytest.approx((300, 150), rel=0.01),
        )
        for kind in ("PNG", "JPEG", "TIFF")
    ],
}


@pytest.mark.parametrize("entry", load_declarations("photo"), ids=lambda entry: entry.declares)
def test_what_a_picture_declares_is_used_refused_or_said_as_the_list_has_it(entry, reading):
    answers = set()
    for content, suffix, right in CASES[entry.declares]:
        if isinstance(right, str) and right == "unreadable":
            answers.add("refused")
            with pytest.raises(PhotoRejected, match="unreadable"):
                reading(content, suffix)
            continue
        photo = reading(content, suffix)
        if isinstance(right, str):
            answers.add("said")
            assert right in photo.said
        elif callable(right):
            assert right(photo)
        else:
            np.testing.assert_allclose(colors_of(photo), right, atol=3 if suffix in ("jpeg", "jpg", "avif") else 1.1)
            assert set(photo.said) <= {color_space.BARE_INKS, color_space.LINEAR_LIGHT}
    assert answers <= {entry.answer}


@pytest.mark.parametrize("odd", odd_headers())
def test_a_header_of_which_the_decoder_warns_hides_no_damage(odd, reading, capfd):
    whole = noise_jpeg()
    np.testing.assert_array_equal(reading(odd(whole), "jpg").srgb, reading(whole, "jpg").srgb)
    with pytest.raises(PhotoRejected, match="unreadable"):
        reading(odd(whole[: len(whole) // 2] + whole[len(whole) // 2 + 900 :]), "jpg")
    assert not capfd.readouterr().err


def test_float_light_up_to_65535_is_said_to_be_light(reading):
    assert color_space.LINEAR_LIGHT in reading(tiff(np.float32([[0, 65535], [9, 7]])), "tif").said


def test_each_case_is_of_an_entry():
    assert CASES.keys() == {entry.declares for entry in load_declarations("photo")}
