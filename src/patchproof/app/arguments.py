"""Check the arguments of public functions, and give those functions the free cores that the command line gives.

In: a function of the package's `__init__.pyi`, and what a user passed to it. Out: arguments that its annotations
describe, with NumPy's numbers as Python's; anything else is refused in one sentence that names the argument and its
value. Loaded with the first public function that is used: the command line checks its options itself.
"""

import builtins
import inspect
import math
import os
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache, wraps
from importlib import import_module
from numbers import Integral, Real
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from patchproof.base.compute import Compute
from patchproof.base.errors import Refused
from patchproof.base.text import brief
from patchproof.base.validation import spelling_hint

_WORDS = {str: "text", int: "a whole number", float: "a finite number", bool: "True or False", Path: "a path"}
_WORDS |= {np.ndarray: "an array", types.NoneType: "None"}
_LEAST = {"n": 1, "copies": 1, "sessions": 1, "steps": 1, "jobs": 1, "input_px": 8, "seed": 0, "ledger_photos": 0}
_ADVICE = {  # by the name of a type
    "Trimesh": "load it with trimesh, or name its path as object.mesh in the settings",
    "Run": "load it with load_run, or make it with optimize",
    "Scene": "load a file with load_scene, or make one with make_scene",
    "Classifier": "wrap it with classifier_of or detector_of",
    "Stage": "make one with set_stage(scene)",
    "Conditions": "draw them with scene.draw",
    "SceneSettings": "load a file with load_scene, or give its tables as a dictionary",
}
_BY_NAME = ("evaluate", "compare")  # whose processes load networks by name
_OPTIONS = ("Compute", "PromiseOptions", "CaptureInfo", "ReprintSetup")
Function = TypeVar("Function", bound=Callable[..., Any])


class _Misfit(Exception):
    """A value that an annotation does not describe, in words."""


def checked(function: Function, name: str) -> Function:
    """The public function `name` of the package with checked arguments; what it refuses is said in Python's words."""
    parameters = inspect.signature(function).parameters

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            arguments = inspect.signature(function).bind(*args, **kwargs)
        except TypeError as error:
            unknown = [key for key in kwargs if key not in parameters]
            do = spelling_hint(unknown[0], parameters) if unknown else f"its parameters are {', '.join(parameters)}"
            raise Refused(f"arguments that {name} takes", str(error).removeprefix("got "), do) from None
        for key, value in arguments.arguments.items():
            if key != "network":  # classifier_of says more about what is none
                hint = _resolved(parameters[key].annotation, function.__module__)
                arguments.arguments[key] = _checked_value(value, hint, key, f"{key} of {name}")
        try:
            if "device" in arguments.arguments:
                from patchproof.optimizer.problem import check_device

                check_device(arguments.arguments["device"])
            with _free_cores(arguments.arguments, name) if "compute" in parameters else _nothing():
                return function(*arguments.args, **arguments.kwargs)
        except Refused as refused:
            words = tuple(map(_python_words, refused.__reduce__()[1]))
            raise refused if words == refused.__reduce__()[1] else type(refused)(*words) from refused.__cause__

    call.__module__, call.__qualname__ = "patchproof", name  # where pickle finds it
    return call  # pyright: ignore[reportReturnType]


@contextmanager
def _nothing() -> Iterator[None]:
    yield


@contextmanager
def _free_cores(arguments: dict[str, Any], name: str) -> Iterator[None]:
    """Fill in `compute` where it was left out, and compute on one thread where processes share the work."""
    from patchproof.base.workers import share_cores

    compute = arguments.get("compute")
    in_memory = name in _BY_NAME and any(not isinstance(model, str) for model in arguments.get("models") or ())
    jobs = compute.jobs if compute else 1 if in_memory else None
    known = compute or Compute()
    with share_cores(jobs, known.device, known.cluster) as jobs:
        arguments["compute"] = replace(known, jobs=jobs)
        yield


def _python_words(text: str) -> str:
    """The sentence of a command line with keywords in place of its options."""
    text = re.sub(r"--(overwrite|resume|trust)\b", r"\1=True", text)
    return re.sub(r"--([a-z][a-z-]+)", lambda match: match[1].replace("-", "_"), text)


class _Names(Mapping[str, Any]):
    """The names within a quoted annotation: a module's own, else a public one, else a library."""

    def __init__(self, module: str):
        self.module = sys.modules[module]

    def __getitem__(self, name: str) -> Any:
        if hasattr(builtins, name):
            raise KeyError(name)
        public = getattr(sys.modules["patchproof"], name, None) if not hasattr(self.module, name) else None
        return getattr(self.module, name, public) or import_module(name)

    def __iter__(self) -> Iterator[str]:
        return iter(vars(self.module))

    def __len__(self) -> int:
        return len(vars(self.module))


@lru_cache(maxsize=256)
def _resolved(annotation: Any, module: str) -> Any:
    return eval(annotation, {}, _Names(module)) if isinstance(annotation, str) else annotation


def _checked_value(value: Any, hint: Any, key: str, what: str) -> Any:
    """The value as its annotation has it; refused if it is something else, or below the key's least number."""
    try:
        value = _convert(value, hint, what)
    except _Misfit as misfit:
        raise Refused(f"{what} as {_words(hint)}", str(misfit), _advice(hint, value)) from None
    if isinstance(value, int) and not isinstance(value, bool) and value < _LEAST.get(key, value):
        raise Refused(f"{what} of {_LEAST[key]} or more", f"{value}", "give a larger one")
    return value


def _convert(value: Any, hint: Any, what: str) -> Any:
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin is Annotated:
        return _convert(value, parts[0], what)
    if origin in (Union, types.UnionType):
        return _convert_union(value, parts, what)
    if origin is Literal and any(value == part and type(value) is type(part) for part in parts):
        return value
    if (origin in (None, types.NoneType) and value is None) or hint in (Any, object, inspect.Parameter.empty):
        return value
    is_flag = isinstance(value, bool | np.bool_)
    if origin is bool and is_flag:
        return bool(value)
    if origin is int and isinstance(value, Integral) and not is_flag:
        return int(value)
    if origin is float and isinstance(value, Real) and not is_flag and math.isfinite(value):
        return float(value)
    if origin is Path and isinstance(value, os.PathLike):
        return Path(value)
    is_list = hasattr(value, "__iter__") and hasattr(value, "__len__") and not isinstance(value, str | bytes | Mapping)
    if origin is tuple and is_list and (Ellipsis in parts or len(parts) == len(value)):
        return tuple(_convert_items(value, parts[:1] * len(value) if Ellipsis in parts else parts, what))
    if getattr(origin, "__name__", "") in ("Sequence", "Iterable") and is_list:
        return _convert_items(value, parts[:1] * len(value), what)
    if getattr(origin, "__name__", "") == "Callable" and callable(value):
        return value
    is_plain = origin not in (int, float, bool, tuple) and getattr(origin, "__module__", "") != "collections.abc"
    if isinstance(origin, type) and isinstance(value, origin) and is_plain | (origin is Mapping):
        return _convert_fields(value) if type(value).__name__ in _OPTIONS else value
    if getattr(origin, "__name__", "") == "Classifier" and hasattr(value, "input_px"):
        from patchproof.classifier.custom import labeled_module

        return labeled_module(value, "python:network")
    raise _Misfit(brief(value))


def _convert_union(value: Any, parts: tuple[Any, ...], what: str) -> Any:
    found = None
    for part in parts:
        try:
            return _convert(value, part, what)
        except _Misfit as misfit:  # the sentence about an item says more than that about the whole list
            found = misfit if found is None or " at index " in str(misfit) else found
    raise found or _Misfit(brief(value))


def _convert_items(values: Any, hints: tuple[Any, ...], what: str) -> list[Any]:
    found = []
    for number, (value, hint) in enumerate(zip(values, hints, strict=True)):
        try:
            found.append(_convert(value, hint, what))
        except _Misfit as misfit:
            raise _Misfit(f"{misfit} at index {number}") from None
    return found


def _convert_fields(options: Any) -> Any:
    """Options such as Compute with checked fields."""
    name, hints = type(options).__name__, get_type_hints(type(options))
    values = {key: _checked_value(getattr(options, key), hint, key, f"{key} of {name}") for key, hint in hints.items()}
    return replace(options, **values)


def _words(hint: Any) -> str:
    origin, parts = get_origin(hint) or hint, get_args(hint)
    if origin in (Union, types.UnionType):
        words = list(dict.fromkeys(_words(part) for part in parts if part is not types.NoneType))
        return " or ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
    if origin is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if origin is tuple:
        return f"{len(parts)} values" if Ellipsis not in parts else f"a list, each item {_words(parts[0])}"
    name = getattr(origin, "__name__", str(origin))
    if name in ("Sequence", "Iterable"):
        return f"a list, each item {_words(parts[0])}"
    return _WORDS.get(origin, {"Callable": "a function", "Mapping": "a dictionary"}.get(name, f"a {name}"))


def _advice(hint: Any, value: Any) -> str:
    if isinstance(value, str) and "a list" in _words(hint):
        return f'write a list: ["{value}"]'
    advice = [do for name, do in _ADVICE.items() if re.search(rf"\b{name}\b", str(hint))]
    options = [f"write {name}(...)" for name in _OPTIONS if name in str(hint)]
    return (advice or options or [f"give {_words(hint)}"])[0]
