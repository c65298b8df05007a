"""A torch.export archive made harmless before torch reads it.

In: the bytes of NAME.pt2, from anyone. Out: the same program in memory, rewritten from what was checked, or a refusal.
An archive can make torch.export.load run code in many ways, and each is shut here: pickled weights and constants
(`use_pickle`, custom and opaque objects, older layouts), sample inputs (a pickle even in honest files: left out),
compiled libraries, and, in the program's JSON itself, operator names that resolve to any Python function, shape
expressions and guards that are evaluated as Python, and tree specifications that import modules. Members and operators
are allowed by list, so what a later torch adds is refused until it is looked at. The second lock is in program.py.

Source: torch/export/pt2_archive/_package.py, torch/_export/serde/serialize.py, torch/export/_unlift.py (torch 2.13).
"""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from pathlib import Path
from typing import Any

from patchproof.strict import Refused

MAX_JSON_BYTES = 256 << 20
MAX_NUMBERS = 1 << 31  # in one tensor

_WEIGHTS, _CONSTANTS = "data/weights/model_weights_config.json", "data/constants/model_constants_config.json"
_PROGRAM, _SAMPLE = "models/model.json", "data/sample_inputs/model.pt"
_KEPT = re.compile(r"archive_format|archive_version|byteorder|data/weights/weight_\d+|data/constants/tensor_\d+")
_LEFT_OUT = re.compile(r"\.data/(version|serialization_id)|\.format_version|\.storage_alignment|extra/[\w./ -]*")

_OPERATOR = re.compile(r"torch\.ops\.(aten|prims)\.(\w+)\.(\w+)")
_ARITHMETIC = frozenset(
    [f"_operator.{name}" for name in "getitem add sub mul truediv floordiv mod neg eq ne lt le gt ge and_ or_".split()]
    + [f"torch.sym_{name}" for name in "int float max min not ite sum".split()]
    + ["math.ceil", "math.floor", "math.trunc"]
)
_ARGUMENTS = frozenset(
    "as_none as_tensor as_tensors as_optional_tensor as_optional_tensors as_nested_tensors as_int as_ints as_int_lists "
    "as_float as_floats as_float_lists as_bool as_bools as_complex as_string as_strings as_sym_int as_sym_ints "
    "as_sym_float as_sym_floats as_sym_bool as_sym_bools as_scalar_type as_memory_format as_layout as_device as_name "
    "as_expr".split()
)
# A shape such as "Mul(Integer(49), Symbol('s77', positive=True))" or "49*s77": numbers, symbols and these names. No
# attribute, no index, no other string, and no power, which alone could run for ever.
_SHAPE = re.compile(
    r"(?:'[suz]\d{1,9}'|[suz]\d{1,9}|\d{1,18}(?:\.\d{1,18})?|\*(?!\*)|[-+/(),= ]"
    r"|Symbol|Integer|Add|Mul|Max|Min|Mod|PythonMod|FloorDiv|CeilDiv|CleanDiv|IntTrueDiv|TruncToInt|CeilToInt|FloorToInt"
    r"|positive|nonnegative|integer|True|False){1,2000}"
)
_TREES = frozenset([None, "builtins.tuple", "builtins.list", "builtins.dict"])


def harmless_copy(stored: bytes, path: Path) -> io.BytesIO:
    """The archive, rewritten from its checked members; refused in one sentence where there is anything else in it."""
    try:
        with zipfile.ZipFile(io.BytesIO(stored)) as archive:
            members = _members(archive, len(stored), path)
            clean = _clean_members({name: archive.read(info) for name, info in members.items()}, path)
    except (zipfile.BadZipFile, EOFError, OSError, NotImplementedError, RuntimeError) as error:
        raise Refused("a torch.export program", f"{path}, which is no whole zip archive ({error})", _SAVE) from error
    copy = io.BytesIO()
    with zipfile.ZipFile(copy, "w", zipfile.ZIP_STORED) as archive:
        for name, content in clean.items():
            archive.writestr(f"program/{name}", content)
    copy.seek(0)
    return copy


_SAVE = "save the network with torch.export.save, torch 2.9 or later"


def _members(archive: zipfile.ZipFile, size: int, path: Path) -> dict[str, zipfile.ZipInfo]:
    """The members by their name below the archive's one folder, each of them allowed; sample inputs are left out."""
    members: dict[str, zipfile.ZipInfo] = {}
    infos = archive.infolist()
    root = infos[0].filename.partition("/")[0] if infos else ""
    for info in infos:
        folder, _, name = info.filename.partition("/")
        if (name.endswith((".pkl", ".pt", ".pth")) and name != _SAMPLE) or "/" not in info.filename:
            got = f"{path} with {info.filename}, a pickle or an older layout"
            raise Refused("a torch.export program without pickles", got, _SAVE)
        wanted = _KEPT.fullmatch(name) or name in (_WEIGHTS, _CONSTANTS, _PROGRAM)
        strange = folder != root or ".." in info.filename or name in members
        if strange or not (wanted or name == _SAMPLE or _LEFT_OUT.fullmatch(name)):
            raise Refused("a torch.export program with the usual members", f"{path} with {info.filename!r}", _SAVE)
        if wanted:
            members[name] = info
    # torch stores without compression, so members cannot be larger than their file, unless they overlap or are a bomb
    if sum(info.file_size for info in members.values()) > size:
        raise Refused("a torch.export program", f"{path}, whose members are larger than the file", _SAVE)
    missing = {"archive_format", "archive_version", _WEIGHTS, _CONSTANTS, _PROGRAM} - members.keys()
    if missing:
        raise Refused("a torch.export program", f"{path} without {sorted(missing)[0]}", _SAVE)
    return members


def _clean_members(contents: dict[str, bytes], path: Path) -> dict[str, bytes]:
    """Contents with checked configurations and a harmless program, and no sample inputs (none is a valid choice)."""
    if contents["archive_format"] != b"pt2" or contents.get("byteorder", b"little") != b"little":
        raise Refused("a little-endian torch.export program", f"{path} in another format", _SAVE)
    try:
        for config in (_WEIGHTS, _CONSTANTS):
            contents[config] = _dumped(_clean_config(_parsed(contents[config]), config, contents))
        contents[_PROGRAM] = _dumped(_clean_program(_parsed(contents[_PROGRAM])))
    except _Unwanted as error:
        raise Refused("a torch.export program of plain tensors and operators", f"{path} with {error}", _EVAL) from error
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        got = f"{path}, whose description cannot be read ({type(error).__name__})"
        raise Refused("a torch.export program", got, _SAVE) from error
    # torch.load of no bytes is not called at all
    return {**contents, _SAMPLE: b"", ".data/version": b"6\n"}


_EVAL = "export it in evaluation mode, without custom operators, control flow or tensor subclasses"


class _Unwanted(Exception):
    """Something in the archive that could run code."""


def _parsed(content: bytes) -> dict[str, Any]:
    if len(content) > MAX_JSON_BYTES:
        raise _Unwanted(f"a description of more than {MAX_JSON_BYTES >> 20} MiB")
    return json.loads(content)


def _dumped(value: dict[str, Any]) -> bytes:
    """JSON from what was checked: another parser cannot see other values in it, such as a second equal key."""
    return json.dumps(value).encode()


def _clean_config(config: dict[str, Any], name: str, contents: dict[str, bytes]) -> dict[str, Any]:
    """A list of tensors, each of them raw bytes that are there."""
    folder, prefix = name.rpartition("/")[0], "weight_" if name == _WEIGHTS else "tensor_"
    for tensor, meta in config["config"].items():
        if meta["use_pickle"] is not False or not str(meta["path_name"]).startswith(prefix):
            raise _Unwanted(f"{tensor!r} stored as a pickle")
        if f"{folder}/{meta['path_name']}" not in contents:
            raise _Unwanted(f"{tensor!r} stored nowhere")
        if math.prod(int(size["as_int"]) for size in meta["tensor_meta"]["sizes"]) > MAX_NUMBERS:
            raise _Unwanted(f"{tensor!r} of an absurd size")
    return config


def _clean_program(program: dict[str, Any]) -> dict[str, Any]:
    """The program without guards, notes and anything that resolves to other than an operator on tensors."""
    if "guards_code" in program:
        program["guards_code"] = []  # torch would run them as Python; ranges of sizes are checked without them
    module = program["graph_module"]
    module["metadata"] = {}
    for node in module["graph"]["nodes"]:
        node["metadata"] = {}  # where each operator came from: only names, but names that are looked up
        _check_operator(node["target"])
    if module["graph"].get("custom_obj_values"):
        raise _Unwanted("custom objects")
    _check_tree(program)
    return program


def _check_tree(value: Any) -> None:
    """Every dictionary in the program, wherever it lies: argument kinds, shape expressions and tree specifications."""
    if isinstance(value, list):
        for item in value:
            _check_tree(item)
    if not isinstance(value, dict):
        return
    for key, item in value.items():
        if key.startswith("as_") and key not in _ARGUMENTS:
            raise _Unwanted(f"an argument of kind {key!r}")
        if key == "expr_str" and not _SHAPE.fullmatch(item):
            raise _Unwanted(f"the shape {item[:60]!r}")
        if key in ("in_spec", "out_spec") and item:
            _check_pytree(json.loads(item)[1])
        _check_tree(item)


def _check_pytree(spec: dict[str, Any]) -> None:
    context = json.loads(spec["context"]) if spec["context"] is not None else None
    names = isinstance(context, list) and all(isinstance(key, str) for key in context)
    if spec["type"] not in _TREES or not (context is None or names):
        raise _Unwanted(f"inputs or outputs of type {spec['type']!r}")
    for child in spec["children_spec"]:
        _check_pytree(child)


def _check_operator(target: str) -> None:
    """Only tensor operators of ATen that touch no file, and arithmetic on sizes."""
    import torch

    match = _OPERATOR.fullmatch(target)
    if match:
        packet = getattr(getattr(torch.ops, match[1]), match[2], None)
        operator = getattr(packet, match[3], None)
        if isinstance(operator, torch._ops.OpOverload):
            if not any("filename" in argument.name for argument in operator._schema.arguments):
                return
    elif target in _ARITHMETIC:
        return
    raise _Unwanted(f"the operator {target[:80]!r}")
