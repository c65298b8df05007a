"""Write every key of scene files and page templates, what files may declare, or photographs' codes, as Markdown.

In: the settings classes; the readers' own lists of declarations. Out: per table a row per key: type and range, unit,
default, meaning; a table for each kind of input. The meaning is the comment at the end of the field's last line or,
without one, the comment above the field. What is in no list is not read, such as sidecar files or comments in a file.
"""

import ast
import inspect
import json
import textwrap
from collections.abc import Iterator, Mapping
from enum import Enum
from functools import lru_cache, partial
from itertools import takewhile
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from pydantic import AfterValidator, BaseModel
from pydantic.fields import FieldInfo

from patchproof.base.declarations import Declaration, load_declarations
from patchproof.base.errors import Refused
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import StrictModel, check_ordered, models_in, spelling_hint
from patchproof.photo.rejection import REJECTION_CODES
from patchproof.sheets.template import BoardTemplate, Template

HEAD = """# All keys

Printed by `patchproof keys`; the text is that of the settings classes. A key that does not exist is refused with the
nearest one that does. `[low, high]` is a range to draw from. Paths are relative to the file that names them, and
`${VAR}` in them is expanded.
"""
_UNITS = {"mm": "mm", "deg": "°", "px": "px", "ev": "stops"}
_WORDS = {str: "text", int: "integer", float: "number", bool: "true or false"}

Documents = Mapping[str, tuple[str, type[StrictModel]]]  # by name, the purpose of a settings file and its class
DOCUMENTS: Documents = {
    "scene": ("A scene file: `patchproof optimize`, `plan`.", SceneSettings),
    "template": ("A page template: `patchproof sheet --template FILE.toml`.", Template),
    "board": ("A page template with a board that calibrates cameras.", BoardTemplate),
}
FILES_HEAD = """# What files declare

Printed by `patchproof keys --files` from the lists of the readers. *used*: taken as the file says. *refused*: one
sentence, exit code 1 (a photograph: rejected with its code). *said*: left aside, with a line in the command's output,
the preview and the report.
"""
# the kinds of input, and the rooms whose `declarations.csv` lists what they can declare
READERS = {
    "Meshes": "mesh",
    "Networks": "classifier",
    "Photographs and pictures": "photo",
    "PDFs": "sheets",
    "Settings and text files": "base",
    "Boxes": "evidence",
}


def keys_page(documents: Documents, name: str | None = None, head: str = HEAD) -> str:
    """Write the page of all documents as Markdown, or the part on the document `name`."""
    if name is None:
        return "\n".join([head, *(_document(name, *document) for name, document in documents.items())])
    if name not in documents:
        raise Refused(f"one of {', '.join(documents)}", f'"{name}"', spelling_hint(name, documents))
    return _document(name, *documents[name])


@lru_cache
def meanings(model: type[BaseModel]) -> dict[str, str]:
    """Read the comments that explain a class's keys, by key; keys without a comment are missing."""
    texts = {}
    for owner in reversed(model.__mro__):
        if not issubclass(owner, StrictModel) or owner is StrictModel:
            continue
        source = inspect.getsource(owner)
        lines = source.splitlines()
        (definition,) = ast.parse(source).body
        for field in definition.body if isinstance(definition, ast.ClassDef) else ():
            if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name):
                above = takewhile(lambda line: line.startswith("    # "), lines[field.lineno - 2 :: -1])
                comment = " ".join([*above][::-1]).replace("    # ", "")
                text = lines[(field.end_lineno or field.lineno) - 1].partition("  # ")[2] or comment
                texts |= {field.target.id: text} if text else {}
    return texts


def _document(name: str, about: str, settings: type[StrictModel]) -> str:
    """Write one document's tables."""
    lines = [f"## {name}", "", about, ""]
    for path, model in tables(settings):
        lines += [f"### {name}: `{path}`", ""] if path else []
        lines += [_cell(model.__doc__ or ""), "", "| key | value | unit | default | meaning |", "|---|---|---|---|---|"]
        lines += [_row(model, key, field, path) for key, field in model.model_fields.items()] + [""]
    return "\n".join(lines)


def tables(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, type[BaseModel]]]:
    """Iterate over the settings and the tables in them, each with its path as in TOML."""
    yield path, model
    for key, hint in get_type_hints(model).items():
        is_array = any(get_origin(each) is tuple for each in (hint, *get_args(hint)))
        for inner in models_in(hint):
            inner_path = f"{path.strip('[]')}.{key}".strip(".")
            yield from tables(inner, f"[[{inner_path}]]" if is_array else f"[{inner_path}]")


def _row(model: type[BaseModel], key: str, field: FieldInfo, path: str) -> str:
    hint = get_type_hints(model, include_extras=True)[key]
    kind, inner = _kind(hint), next(models_in(hint), None)
    table = "" if inner is None else f"the table `[{path.strip('[]')}.{key}]`".replace("[.", "[")
    meaning = meanings(model).get(key, table)
    cells = (f"`{key}`", kind, _UNITS.get(key.rpartition("_")[2], ""), default_text(field), meaning)
    return "| " + " | ".join(map(_cell, cells)) + " |"


def _cell(text: str) -> str:
    return " ".join(text.replace("|", "\\|").split())


def default_text(field: FieldInfo) -> str:
    """Format a key's default as a cell of the page."""
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    return "none" if value is None else f"`{toml_text(value)}`"


def toml_text(value: Any) -> str:
    """Format a value as TOML, numbers with four digits."""
    if isinstance(value, StrictModel):
        value = value.model_dump(exclude_defaults=True)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {toml_text(inner)}" for key, inner in value.items()) + "}"
    if isinstance(value, tuple):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    if value is None:
        return '"none"'
    return f"{value:.4g}" if isinstance(value, float) else json.dumps(value, ensure_ascii=False)


def _kind(hint: Any, checks: tuple[Any, ...] = (), plural: str = "") -> str:
    """Describe a type for somebody who writes TOML, with its range."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _kind(inner[0], (*checks, *inner[1:]), plural)
    if origin in (Union, UnionType):
        return " or ".join(_kind(member, checks, plural) for member in inner if member is not type(None))
    if origin is Literal or (isinstance(hint, type) and issubclass(hint, Enum)):
        return ", ".join(f'`"{value}"`' for value in (inner or hint))
    if origin is dict:
        return f"table{plural} of {_kind(inner[1], plural='s')}"
    if origin is tuple and inner[-1] is Ellipsis:
        least = max((value for name, value in _bounds(checks) if name == "min_length"), default=0)
        return f"list of {_kind(inner[0], plural='s')}{ {0: '', 1: ', not empty'}.get(least, f', {least} or more') }"
    if origin is tuple and AfterValidator(check_ordered) in checks:
        return f"[low, high]{_range((*get_args(inner[0])[1:], *checks))}"
    if origin is tuple:
        kinds = {_kind(member, plural="s") for member in inner}
        return f"[{len(inner)} {kinds.pop() if len(kinds) == 1 else 'numbers'}]"
    word = "table" if isinstance(hint, type) and issubclass(hint, StrictModel) else _WORDS.get(hint, "value")
    return word + plural + _range(checks)


def _range(checks: tuple[Any, ...]) -> str:
    """Describe the tightest bounds; of two equal bounds, the one that excludes the end."""
    bounds = _bounds(checks)
    low = max(((value, name == "gt") for name, value in bounds if name in ("ge", "gt")), default=None)
    high = min(((value, name == "le") for name, value in bounds if name in ("le", "lt")), default=None)
    if low and high and (low[1], high[1]) == (False, True):
        return f", {low[0]:.10g} to {high[0]:.10g}"
    above = f", {'>' if low[1] else '≥'} {low[0]:.10g}" if low else ""
    return above + (f", {'≤' if high[1] else '<'} {high[0]:.10g}" if high else "")


def _bounds(checks: tuple[Any, ...]) -> list[tuple[str, Any]]:
    """List the bounds in a type's checks, with pydantic's names."""
    names, bounds = ("ge", "gt", "le", "lt", "min_length"), []
    for check in checks:
        if isinstance(check, AfterValidator) and isinstance(check.func, partial):  # validation.within
            bounds += zip(("ge", "le"), check.func.args, strict=True)
        for limit in getattr(check, "metadata", ()):
            bounds += [(name, getattr(limit, name)) for name in names if hasattr(limit, name)]
    return bounds


def declarations(reader: str) -> tuple[Declaration, ...]:
    """The list of one kind of input in `READERS`."""
    return load_declarations(READERS[reader])


def codes_table() -> str:
    """Write the codes of rejected and judged photographs as a Markdown table."""
    rows = [f"| `{code}` | {meaning} | {remedy} |" for code, (meaning, remedy) in REJECTION_CODES.items()]
    return "\n".join(["| code | it says | what helps |", "|---|---|---|", *rows, ""])


def files_page() -> str:
    """Write the page of all kinds of input as Markdown."""
    lines = [FILES_HEAD]
    for reader in READERS:
        lines += [f"## {reader}", "", "| file | declares | answer | how |", "|---|---|---|---|"]
        lines += [f"| {' | '.join(entry)} |" for entry in declarations(reader)] + [""]
    from patchproof.networks.onnx_operators import OPERATORS, REFUSED

    computed = ", ".join(sorted({*OPERATORS, "Constant", "Identity"}))
    lines += ["## ONNX operators", "", *textwrap.wrap(f"Computed, with gradients: {computed}.", 120), ""]
    lines += [f"Refused is what {reason}: {', '.join(names.split())}.\n" for reason, names in REFUSED.items()]
    return "\n".join(lines)
