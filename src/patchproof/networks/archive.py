"""A torch.export archive, read without torch.export: its program as JSON, its weights as tensors.

In: the bytes of NAME.pt2, from anyone. Out: plain tensors and what its JSON says, of which nothing is believed yet (see
description.py), or a refusal. Members are allowed by list, so what a later torch adds is refused until it is looked at.
Left out on purpose, because they are or may be pickles: sample inputs (in honest files too: never read), tensor
subclasses, custom and opaque objects, layouts older than torch 2.9's; and compiled libraries.

Source: torch/export/pt2_archive/_package.py, torch/_export/serde/schema.py (torch 2.13).
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any, NoReturn

import torch
from torch import Tensor

from patchproof.base.strict import Refused

MAX_JSON_BYTES = 32 << 20  # MobileNetV2's has 135 thousand bytes
MAX_NUMBERS = 1 << 31  # in all weights together
MAX_DIMENSIONS = 12

_WEIGHTS, _CONSTANTS = "data/weights/model_weights_config.json", "data/constants/model_constants_config.json"
_PROGRAM, _SAMPLE = "models/model.json", "data/sample_inputs/model.pt"
_JSON = (_WEIGHTS, _CONSTANTS, _PROGRAM)
_KEPT = re.compile(r"archive_format|archive_version|byteorder|data/weights/weight_\d+|data/constants/tensor_\d+")
_LEFT_OUT = re.compile(r"\.data/(version|serialization_id)|\.format_version|\.storage_alignment|extra/[\w./ -]*")
_SAVE = "save the network with torch.export.save, torch 2.9 or later"

# the numbers of ScalarType and Layout in schema.py
DTYPES = {
    1: torch.uint8,
    2: torch.int8,
    3: torch.int16,
    4: torch.int32,
    5: torch.int64,
    6: torch.float16,
    7: torch.float32,
    8: torch.float64,
    12: torch.bool,
    13: torch.bfloat16,
}
STRIDED = 7


class Unwanted(Exception):
    """Something in the archive that is not allowed; the text follows "the file with"."""


def quoted(value: Any) -> str:
    """Whatever stands in the file, short and on one line."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def whole(value: Any, low: int, high: int) -> int:
    """A whole number from `low` to `high`, and not one in disguise."""
    if type(value) is not int or not low <= value <= high:
        raise Unwanted(f"{quoted(value)} for a whole number from {low} to {high}")
    return value


def read_archive(stored: bytes, path: Path) -> tuple[dict[str, Any], dict[str, dict[str, Tensor]]]:
    """The program's JSON, and the tensors by their names in the file under "weights" and "constants"."""
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            members = _members(archive, len(stored), path)
            contents = {name: archive.read(info) for name, info in members.items()}
    except (zipfile.BadZipFile, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise Refused("a torch.export program", f"{path}, which is no whole zip archive ({error})", _SAVE) from error
    marks = [contents["archive_format"], contents["archive_version"], contents.get("byteorder", b"little")]
    if marks != [b"pt2", b"0", b"little"]:
        raise Refused("a little-endian torch.export program", f"{path} in another format", _SAVE)
    program, weights, constants = (_parsed(contents.pop(name)) for name in (_PROGRAM, _WEIGHTS, _CONSTANTS))
    tensors = {
        "weights": _tensors(weights, "data/weights/weight_", contents),
        "constants": _tensors(constants, "data/constants/tensor_", contents),
    }
    if sum(tensor.numel() for group in tensors.values() for tensor in group.values()) > MAX_NUMBERS:
        raise Unwanted("weights of an absurd size")
    return program, tensors


def _members(archive: zipfile.ZipFile, size: int, path: Path) -> dict[str, zipfile.ZipInfo]:
    """The members by their name below the archive's one folder, each of them allowed; sample inputs are left out."""
    members: dict[str, zipfile.ZipInfo] = {}
    infos = archive.infolist()
    root = infos[0].filename.partition("/")[0] if infos else ""
    for info in infos:
        folder, _, name = info.filename.partition("/")
        if (name.endswith((".pkl", ".pt", ".pth")) and name != _SAMPLE) or "/" not in info.filename:
            got = f"{path} with {quoted(info.filename)[1:-1]}, a pickle or an older layout"
            raise Refused("a torch.export program without pickles", got, _SAVE)
        wanted = _KEPT.fullmatch(name) or name in _JSON
        strange = folder != root or ".." in info.filename or name in members
        if strange or not (wanted or name == _SAMPLE or _LEFT_OUT.fullmatch(name)):
            got = f"{path} with {quoted(info.filename)}"
            raise Refused("a torch.export program with the usual members", got, _SAVE)
        if wanted:
            members[name] = info
    # torch stores without compression, so members cannot be larger than their file, unless they overlap or are a bomb
    if sum(info.file_size for info in members.values()) > size:
        raise Refused("a torch.export program", f"{path}, whose members are larger than the file", _SAVE)
    missing = {"archive_format", "archive_version", *_JSON} - members.keys()
    if missing:
        raise Refused("a torch.export program", f"{path} without {sorted(missing)[0]}", _SAVE)
    return members


def _parsed(content: bytes) -> dict[str, Any]:
    if len(content) > MAX_JSON_BYTES:
        raise Unwanted(f"a description of more than {MAX_JSON_BYTES >> 20} MiB")
    return json.loads(content, parse_constant=_no_number, object_pairs_hook=_object)


def _no_number(name: str) -> NoReturn:
    raise Unwanted(f"{name}, which is no JSON")


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A JSON object in which no key stands twice, so that no two readers can see different programs."""
    table = dict(pairs)
    if len(table) != len(pairs):
        raise Unwanted("the same key twice")
    return table


def _tensors(config: dict[str, Any], prefix: str, contents: dict[str, bytes]) -> dict[str, Tensor]:
    """The tensors that a configuration lists, each of them a view of raw bytes that are there."""
    files: dict[str, Tensor] = {}
    tensors = {}
    for name, meta in config["config"].items():
        file = f"{prefix.rpartition('/')[0]}/{meta['path_name']}"
        if meta["use_pickle"] is not False or not file.startswith(prefix):
            raise Unwanted(f"{quoted(name)} stored as a pickle")
        if file not in contents:
            raise Unwanted(f"{quoted(name)} stored nowhere")
        if file not in files:  # several tensors may share one; torch's own memory is aligned for vector units
            files[file] = torch.empty(len(contents[file]), dtype=torch.uint8)
            files[file].numpy()[:] = memoryview(contents[file])
        tensors[name] = _tensor(name, meta["tensor_meta"], files[file])
    return tensors


def _tensor(name: str, meta: dict[str, Any], stored: Tensor) -> Tensor:
    """One tensor, if its sizes, strides and offset stay inside its bytes."""
    dtype = DTYPES.get(whole(meta["dtype"], 0, 99))
    if dtype is None or whole(meta["layout"], 0, 99) != STRIDED:
        raise Unwanted(f"{quoted(name)} of a type that is not supported")
    sizes, strides = ([whole(size["as_int"], 0, 1 << 62) for size in meta[key]] for key in ("sizes", "strides"))
    offset = whole(meta["storage_offset"]["as_int"], 0, 1 << 62)
    if len(sizes) > MAX_DIMENSIONS or math.prod(max(1, size) for size in sizes) > MAX_NUMBERS:
        raise Unwanted(f"{quoted(name)} of an absurd size")
    if len(sizes) != len(strides):
        raise Unwanted(f"{quoted(name)} of {len(sizes)} sizes and {len(strides)} strides")
    if 0 in sizes:
        return torch.empty(sizes, dtype=dtype)
    if max(strides, default=0) > MAX_NUMBERS:
        raise Unwanted(f"{quoted(name)} with a stride of {max(strides)}")
    last = offset + sum((size - 1) * stride for size, stride in zip(sizes, strides, strict=True))
    if (last + 1) * dtype.itemsize > len(stored):
        raise Unwanted(f"{quoted(name)} outside of its bytes")
    bare = stored[: len(stored) // dtype.itemsize * dtype.itemsize]
    if dtype == torch.bool:  # any other byte than 0 and 1 is no truth value
        return bare.as_strided(sizes, strides, offset) != 0
    return bare.view(dtype).as_strided(sizes, strides, offset)
