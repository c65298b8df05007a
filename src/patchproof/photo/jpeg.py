"""Decode a JPEG by OpenCV, strictly: what its decoder warns of is damage.

In: a file's bytes. Out: pixels, or a ValueError. libjpeg fills what it cannot decode with gray or wrong blocks, and
says so on stderr alone, so that is read meanwhile. It says only one thing of a file: where that is an odd header, what
follows is decoded again under a plain one. Zeroed bytes may decode without a warning: a run of them is damage if the
code of zeros is not that of a flat block, where one scan holds all (chroma alone, or a progressive file, may be flat).
Bytes that change within one block leave no trace.
"""

import os
import re
import tempfile
import threading
from contextlib import suppress

import cv2
import numpy as np

_ODD_HEADER = re.compile(rb"unknown JFIF|Unknown Adobe|Invalid SOS")
_WARNING = re.compile(rb"Corrupt JPEG data|Premature end of JPEG|Inconsistent progression|" + _ODD_HEADER.pattern)
_PADDING = re.compile(rb"Corrupt JPEG data: (\d+) extraneous bytes before marker 0xd9\s*")
_MAX_PADDING = 64  # bytes that some cameras write before the end of a picture
_ZERO_RUN = bytes(64)  # takes three blocks of coefficients -1
_LOCK = threading.Lock()  # a process has one stderr


def decode_jpeg(content: bytes, flags: int = cv2.IMREAD_COLOR_RGB) -> np.ndarray | None:
    """uint8 H×W×3 as stored, None where OpenCV cannot decode it; a ValueError if it is damaged."""
    pixels, warning = _decode(content, flags)
    if not warning and _ZERO_RUN not in content:
        return pixels
    start, zeros_are_flat = _start_of_scan(content)
    if _ODD_HEADER.search(warning):
        head = content[:start].replace(b"JFIF\0", b"jfif\0").replace(b"Adobe", b"adobe")
        end = start + 2 + int.from_bytes(content[start + 2 : start + 4])
        plain = b"\0\x3f\0" if b"SOS" in warning else content[end - 3 : end]
        warning = _decode(head + content[start : end - 3] + plain + content[end:], flags)[1]
    scan = content[start : content.find(b"\xff\xd9", start)]
    padding = _PADDING.fullmatch(warning)
    padded = padding and (size := int(padding[1])) <= _MAX_PADDING and not scan[-size:].strip(b"\0\xff")
    zeroed = _ZERO_RUN in scan and not zeros_are_flat and scan.count(b"\xff\xda") == 1
    if (warning and not padded) or zeroed:
        raise ValueError(warning.decode("latin-1") or "zeros among its pixels")
    return pixels


def _decode(content: bytes, flags: int) -> tuple[np.ndarray | None, bytes]:
    """OpenCV's pixels and what libjpeg writes to stderr; other lines there are passed on."""
    pixels, data = None, np.frombuffer(content, np.uint8)
    with _LOCK, tempfile.TemporaryFile() as file:
        try:
            stderr = os.dup(2)
        except OSError:  # a process without stderr
            stderr = os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(file.fileno(), 2)
            with suppress(cv2.error):
                pixels = cv2.imdecode(data, flags | cv2.IMREAD_IGNORE_ORIENTATION)
        finally:
            os.dup2(stderr, 2)
            file.seek(0)
            lines = file.readlines()
            with suppress(OSError):  # 2 is any file in a process without stderr
                os.write(stderr, b"".join(line for line in lines if not _WARNING.search(line)))
            os.close(stderr)
    return pixels, b"".join(filter(_WARNING.search, lines))


def _start_of_scan(content: bytes) -> tuple[int, bool]:
    """The offset of the first scan, and whether zeros can be flat blocks: their code ends one in the first."""
    at, first_symbol = 2, {}
    while at + 4 < len(content) and content[at + 1] != 0xDA:
        end = at + 2 + int.from_bytes(content[at + 2 : at + 4])
        table = at + 4
        while content[at + 1] == 0xC4 and table + 17 < end:
            first_symbol[content[table]] = content[table + 17]
            table += 17 + sum(content[table + 1 : table + 17])
        at = end
    ac_table = 0x10 | content[at + 6] & 15 if at + 6 < len(content) else 0
    return at, first_symbol.get(ac_table, 0) == 0
