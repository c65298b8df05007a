"""Read and validate settings: TOML files or dictionaries into frozen pydantic models.

In: a TOML file or a dictionary, and a model of it. Out: frozen settings with every value checked: an unknown key is
refused with the nearest known one, a NaN or a reversed range with the value. `expand_path` expands `${VAR}` in paths.
"""

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar, get_args

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from patchproof.base.errors import Refused
from patchproof.base.input import read_text
from patchproof.base.text import brief, short_repr

MAX_TOML_BYTES = 1 << 16  # shipped files have 3 kB; the time for a key of many parts grows with their square


def check_ordered(pair: tuple[float, float]) -> tuple[float, float]:
    """Return the range (low, high) unchanged; a ValueError if low is above high."""
    if pair[0] > pair[1]:
        raise ValueError(f"must be [low, high] with low <= high, not [{pair[0]:g}, {pair[1]:g}]")
    return pair


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]  # neither true nor text
Positive = Annotated[Finite, Field(gt=0)]
NotNegative = Annotated[Finite, Field(ge=0)]
RandomSeed = Annotated[int, Field(ge=0, le=2**32 - 1)]
Share = Annotated[Finite, Field(ge=0, le=1)]
Range = Annotated[tuple[Finite, Finite], AfterValidator(check_ordered)]
ShareRange = Annotated[tuple[Share, Share], AfterValidator(check_ordered)]
NotNegativeRange = Annotated[tuple[NotNegative, NotNegative], AfterValidator(check_ordered)]
PositiveRange = Annotated[tuple[Positive, Positive], AfterValidator(check_ordered)]
Side = Literal["+x", "-x", "+y", "-y", "+z", "-z"]
Model = TypeVar("Model", bound=BaseModel)


class StrictModel(BaseModel):
    """Base of frozen settings that refuse unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    __repr__ = short_repr

    def changed(self, **values: Any) -> Self:
        """A copy with some values replaced, checked as a file is. A dictionary replaces single keys of a table, as in
        `scene.changed(optimize={"steps": 10})`.
        """
        tables = {name: getattr(self, name) for name in type(self).model_fields}
        for name, value in values.items():
            if isinstance(table := tables.get(name), StrictModel) and isinstance(value, dict):
                value = table.changed(**value)
            tables[name] = value
        return validate_model(type(self), tables, type(self).__name__)


def read_toml(path: str | Path) -> dict[str, Any]:
    """Read a TOML file as a dictionary; refused if it is missing, not text, or not TOML."""
    text = read_text(path, "a TOML file", max_bytes=MAX_TOML_BYTES)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise Refused("a TOML file", f"{path} that cannot be read ({error})", "correct that line") from error


def validate_model(model: type[Model], data: Any, source: str) -> Model:
    """Validate `data` as a `model`; its first error is refused by key, an unknown key with the nearest known one."""
    try:
        return model.model_validate(data)
    except ValidationError as error:
        # a misspelled key is also a missing one, and its spelling is the more useful message
        errors = sorted(error.errors(), key=lambda error: error["type"] != "extra_forbidden")
        raise _explain(model, errors, data, source) from error


_PLAIN = {"a valid tuple": "a list in square brackets", "tuple": "list"}  # pydantic's words, and a file's
_PLAIN |= {"a valid string": "text in quotes", "a valid boolean": "true or false"}
# a network's name: the part up to its file, and the file
NETWORK_FILE = re.compile(r"(file:|clip:[^@:]+@|(?:torchvision|timm):[^@:]+@(?=.+\.safetensors$))(.*)", re.DOTALL)


def expand_path(text: str, base: Path) -> str:
    """Expand `${VAR}` in a path or a network's name; a relative file is taken relative to `base`."""

    def variable(match: re.Match) -> str:
        if match[1] not in os.environ:
            raise Refused(f"the environment variable {match[1]}", "none", f"set {match[1]} or write the full path")
        return os.environ[match[1]]

    text = re.sub(r"\$\{(\w+)\}", variable, text)
    if match := NETWORK_FILE.fullmatch(text):
        return f"{match[1]}{base / match[2]}"  # an absolute path stays as it is
    prefix, colon, _ = text.partition(":")
    by_prefix = colon and prefix in {"primitive", "torchvision", "timm", "clip", "module", "python", "imagenet"}
    return text if by_prefix or text in ("builtin", "builtin-detector", "imagenet") else str(base / text)


def refuse_untrusted(source: str | Path, networks: Iterable[str] = (), settings: Any = ()) -> None:
    """Refuse what a file of somebody else would have run, downloaded or read of the environment: networks but for files
    and built-in ones, and `${VAR}` in them or in any text of its `settings` (tables, lists, text).
    """
    do = "add --trust if you trust where it is from, or name the networks yourself"
    for name in networks:
        is_local = ":" not in name or name.startswith(("file:", "python:", "imagenet:"))
        if not is_local and (name.startswith("clip:") or not NETWORK_FILE.fullmatch(name)):
            expected = f"networks in {source} that are files, not code or downloads"
            raise Refused(expected, name, f"{do} (--models '{name}')")
    for text in (*networks, *texts_in(settings)):
        if "${" in text:
            raise Refused(f"names in {source} without variables of your environment", text, do)


def texts_in(value: Any) -> Iterator[str]:
    """All text in nested tables and lists."""
    if isinstance(value, str):
        yield value
    for each in value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ():
        yield from texts_in(each)


def spelling_hint(word: str, known_words: Iterable[str], otherwise: str = "", most: int = 1) -> str:
    """'did you mean "x"' for the known words most similar to a word, else `otherwise`, or 'use one of: ...'."""
    known_words = {folded(each): each for each in known_words}
    similar = difflib.get_close_matches(folded(word), known_words, most, 0.5 if most == 1 else 0.6)
    found = " or ".join(f'"{known_words[each]}"' for each in similar)
    return f"did you mean {found}" if found else otherwise or f"use one of: {', '.join(known_words.values())}"


def folded(text: str) -> str:
    """Fold case and underscores."""
    return " ".join(text.casefold().replace("_", " ").split())


def summarize_names(names: Sequence[str]) -> str:
    """The first three names, and the number of further ones: 'a, b, c and 4 more'."""
    return ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


def within(low: float, high: float) -> AfterValidator:
    """A validator of a range: both ends must lie in [low, high]."""
    return AfterValidator(partial(_check_within, low, high))


def _check_within(low: float, high: float, pair: tuple[float, float]) -> tuple[float, float]:
    if pair[0] < low or pair[1] > high:
        raise ValueError(f"must lie within [{low:g}, {high:g}]")
    return pair


def _explain(model: type[BaseModel], errors: Sequence[ErrorDetails], data: Any, source: str) -> Refused:
    """The refusal of the first of pydantic's errors; those of all kinds that its value might have are one reason."""
    error, place = errors[0], _location(errors[0], data)
    key, last = ".".join(map(str, place)), place[-1] if place else ""
    if error["type"] == "extra_forbidden":
        hint = spelling_hint(str(last), _keys_at(model, place[:-1]))
        return Refused(f"only known keys in {source}", f'"{key}"', hint)
    if error["type"] != "missing":
        reasons = dict.fromkeys(_reason(each) for each in errors if _location(each, data) == place)
        reason = " or ".join(reasons).replace(" or input should be", " or")
    elif isinstance(last, int):
        key, reason = ".".join(map(str, place[:-1])), f"needs at least {last + 1} values"
    else:
        return Refused(f'the key "{key}" in {source}', "none", f"add {key}")
    value = error.get("input")
    is_text = isinstance(value, str) and not error["type"].startswith(("value_", "literal_", "string_"))
    value = brief(value) if is_text or callable(value) or hasattr(value, "shape") else str(value)
    value = value if len(value) < 80 else value[:77] + "..."
    if not key:  # tables that contradict each other
        return Refused(f"settings in {source} that agree with each other", "a contradiction", reason)
    do = f"{key} {reason}" if reason.startswith(("must", "takes", "needs")) else reason
    return Refused(f'a usable "{key}" in {source}', value, do)


def _reason(error: ErrorDetails) -> str:
    """What pydantic says of a value, in words of those who write files."""
    text = error["msg"].removeprefix("Value error, ").rstrip(".").replace(" after validation", "")
    text = text[0].lower() + text[1:]
    for theirs, plain in _PLAIN.items():
        text = text.replace(theirs, plain)
    return text


def _location(error: ErrorDetails, data: Any) -> tuple[int | str, ...]:
    """Where an error is, without the kinds of value that were tried there: ("label", "str") is ("label",)."""
    known, location = list[Any](), list[Any](error["loc"])
    for number, part in enumerate(location, 1):
        is_index = isinstance(data, list | tuple) and isinstance(part, int) and part < len(data)
        if (is_known := is_index or (isinstance(data, dict) and part in data)) or (
            error["type"] == "missing" and number == len(location)
        ):
            known.append(part)
            data = data[part] if is_known else None
    return (*known,)


def _keys_at(model: Any, location: tuple) -> Iterable[str]:
    """The known keys of the table at a location; lists, dictionaries and optional tables are looked through."""
    for part in location:
        if part in model.model_fields:  # otherwise it is an index or a key of a dictionary
            model = next(models_in(model.model_fields[part].annotation), model)
    return model.model_fields


def models_in(hint: Any) -> Iterator[type[BaseModel]]:
    """The models within a type hint: the model itself, or those in its arguments."""
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        yield hint
    for inner in get_args(hint):
        yield from models_in(inner)
