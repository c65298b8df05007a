"""Check the arguments of public functions, and give those functions the free cores that the command line gives.

In: a function of the package's `__init__.pyi`, and what a user passed to it. Out: a call with arguments that fit its
annotations, NumPy's numbers as Python's; anything else is refused in one sentence. Loaded with the first public
function that is used: the command line checks its options itself.
"""

import inspect
import math
import re
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import wraps
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.progress import Compute
from patchproof.base.text import brief
from patchproof.base.validation import spelling_hint
from patchproof.base.workers import share_cores

_LEAST = {"n": 1, "copies": 1, "sessions": 1, "steps": 1, "jobs": 1, "input_px": 8, "seed": 0, "ledger_photos": 0}
_OPTIONS = ("Compute", "PromiseOptions", "CaptureInfo", "ReprintSetup")
_ADVICE = {  # by the name of a type
    "Trimesh": "load it with trimesh, or name its path as object.mesh in the settings",
    "Run": "load it with load_run, or make it with optimize",
    "Scene": "load a file with load_scene, or make one with make_scene",
    "Classifier": "wrap it with classifier_of or detector_of",
    "Stage": "make one with set_stage(scene)",
    "Conditions": "draw them with scene.draw",
    "SceneSettings": "load a file with load_scene, or give its tables as a dictionary",
    **{name: f"write {name}(...)" for name in _OPTIONS},
}
_BY_NAME = ("evaluate", "compare")  # whose processes load networks by name
Function = TypeVar("Function", bound=Callable[..., Any])


def checked(function: Function, name: str) -> Function:
    """The public function `name` with checked arguments; its refusals name keywords, not command-line options."""
    signature = inspect.signature(function)
    parameters = signature.parameters

    @wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            bound = signature.bind(*args, **kwargs)
        except TypeError as error:
            unknown = [key for key in kwargs if key not in parameters]
            do = spelling_hint(unknown[0], parameters) if unknown else f"its parameters are {', '.join(parameters)}"
            raise Refused(f"arguments that {name} takes", str(error).removeprefix("got "), do) from None
        values = bound.arguments
        for key in values.keys() - {"network"}:  # classifier_of says more about what is no network
            hint = _resolved(parameters[key].annotation, function.__module__, values[key])
            values[key] = _checked_value(values[key], hint, key, name)
        try:
            if "device" in values:
                from patchproof.optimizer.problem import check_device

                check_device(values["device"])
            with _free_cores(values, name) if "compute" in parameters else nullcontext():
                return function(*bound.args, **bound.kwargs)
        except Refused as refused:
            raise type(refused)(*map(_python_words, refused.__reduce__()[1])) from refused.__cause__

    call.__module__, call.__qualname__ = "patchproof", name  # where pickle finds it
    return call  # pyright: ignore[reportReturnType]


@contextmanager
def _free_cores(values: dict[str, Any], name: str) -> Iterator[None]:
    """Fill in `compute` where it was left out, and compute on one thread where processes share the work."""
    in_memory = name in _BY_NAME and any(not isinstance(model, str) for model in values.get("models") or ())
    given = values.get("compute")
    jobs, known = given.jobs if given else 1 if in_memory else None, given or Compute()
    with share_cores(jobs, known.device, known.cluster) as jobs:
        values["compute"] = replace(known, jobs=jobs)
        yield


def _python_words(text: str) -> str:
    """Replace the command-line options in a sentence by Python keywords."""
    text = re.sub(r"--(overwrite|resume|trust)\b", r"\1=True", text)
    return re.sub(r"--([a-z][a-z-]+)", lambda match: match[1].replace("-", "_"), text)


def _resolved(hint: Any, module: str, value: Any) -> Any:
    """Return an annotation; a quoted one, of types its module does not import, is evaluated if the value needs it."""
    if not isinstance(hint, str):
        return hint
    if value is None or ("str" in hint and isinstance(value, str | Path)):
        return Any
    public = sys.modules["patchproof"]
    return eval(hint, {**vars(sys.modules[module]), "Run": public.Run, "trimesh": import_module("trimesh")})


def _checked_value(value: Any, hint: Any, key: str, owner: str) -> Any:
    """Return an argument's value; refused if it does not fit its annotation or is out of the range of its key."""
    if isinstance(value, np.generic) and not isinstance(value, str):
        value = value.item()
    if (misfit := _misfit(value, hint)) is not None:
        wanted = re.sub(r"[\w.]*\.(\w+)", r"\1", hint.__name__ if isinstance(hint, type) else str(hint))
        advice = next((do for name, do in _ADVICE.items() if re.search(rf"\b{name}\b", wanted)), f"give {wanted}")
        if isinstance(value, str) and re.search(r"\b(Sequence|tuple)\[str", wanted):
            advice = f'write a list: ["{value}"]'
        raise Refused(f"{key} of {owner} as {wanted}", misfit, advice)
    if key in _LEAST and isinstance(value, int) and not _LEAST[key] <= value < 2**32:
        expected = f"{key} of {owner} of {_LEAST[key]} or more (below 2**32)"
        raise Refused(expected, f"{value}", "give a number in that range")
    if (kind := type(value).__name__) in _OPTIONS:
        fields = {name: (getattr(value, name), part) for name, part in get_type_hints(type(value)).items()}
        return type(value)(**{name: _checked_value(field, part, name, kind) for name, (field, part) in fields.items()})
    return value


def _misfit(value: Any, hint: Any) -> str | None:
    """Describe the part of a value that does not fit an annotation; None if all of it fits."""
    origin, parts = get_origin(hint) or hint, get_args(hint)
    kind = getattr(origin, "__name__", "")
    if origin in (Union, types.UnionType):
        found = [_misfit(value, part) for part in parts]
        return None if None in found else max(map(str, found), key=lambda text: " at index " in text)
    if kind in ("Sequence", "Iterable", "tuple"):
        is_list = hasattr(value, "__iter__") and hasattr(value, "__len__")
        if not is_list or isinstance(value, str | bytes | Mapping):
            return brief(value)
        hints = parts[:1] * len(value) if kind != "tuple" or Ellipsis in parts else parts
        found = [_misfit(item, part) for item, part in zip(value, hints, strict=False)]
        wrong = [f"{text} at index {number}" for number, text in enumerate(found) if text is not None]
        return wrong[0] if wrong else None if len(hints) == len(value) else brief(value)
    if hint in (Any, object):
        return None
    if origin is Literal:
        fits = value in parts
    elif origin in (int, float):
        fits = isinstance(value, int | origin) and not isinstance(value, bool) and math.isfinite(value)
    elif kind == "Callable":
        fits = callable(value)
    else:
        fits = isinstance(value, origin or types.NoneType) or (kind == "Classifier" and hasattr(value, "input_px"))
    return None if fits else brief(value)
