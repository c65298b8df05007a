"""A program read from JSON that nobody vouches for.

In: the parsed JSON and the tensors of archive.py. Out: a Program of numbered steps (graph.py), and the batches that it
takes. Nothing of the file is executed: text in it picks operators from the list in operators.py and values by a number
of ours; no name of the file becomes an attribute, a file, Python or a formula. What is not needed is not read: guards,
notes on modules and sources, shapes of values between, specifications of trees.
Left out on purpose: several inputs or outputs, training mode, control flow, custom objects.

Source: torch/_export/serde/schema.py, whose words for arguments are used here, and serialize.py (torch 2.13).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from patchproof.networks.archive import DTYPES, STRIDED, Unwanted, quoted, whole
from patchproof.networks.batches import MAX_BATCH
from patchproof.networks.graph import Program
from patchproof.networks.operators import is_check, operator_named
from patchproof.networks.steps import Here, Step, Value, mark_spent

MAX_STEPS = 1 << 15  # DenseNet-201 has 709
MAX_LIST = 1 << 10  # in one argument
SCHEMA = 8  # since torch 2.6

_INT64 = 1 << 63
_WORD = re.compile(r"[\w ,.>-]{0,100}")
_SYMBOL = re.compile(r"Symbol\('(\w{1,20})'(?:, (?:positive|nonnegative|integer)=True){0,3}\)|(\w{1,20})")
_FLOATS = {"Infinity": float("inf"), "-Infinity": float("-inf"), "NaN": float("nan")}
_FORMATS = {1: torch.contiguous_format, 2: torch.channels_last, 3: torch.channels_last_3d, 4: torch.preserve_format}


def read_program(program: dict[str, Any], tensors: dict[str, dict[str, Tensor]]) -> tuple[Program, int, int]:
    """The network, and the smallest and largest batch that it takes; Unwanted where there is anything else in it."""
    if (major := program["schema_version"]["major"]) != SCHEMA:
        raise Unwanted(f"layout {quoted(major)} of its description, not {SCHEMA}")
    return _Reader(program, tensors).read()


class _Reader:
    """The names of one file, each of them once, and the numbers that stand for them from then on."""

    def __init__(self, program: dict[str, Any], tensors: dict[str, dict[str, Tensor]]):
        self.ranges, self.module = program["range_constraints"], program["graph_module"]
        self.graph, self.tensors = self.module["graph"], tensors
        self.numbers: dict[str, int] = {}
        self.count = 0

    def read(self) -> tuple[Program, int, int]:
        """See read_program."""
        if self.graph.get("custom_obj_values"):
            raise Unwanted("custom objects")
        weights, photos = self._inputs()
        low, high, sizes = self._shape(photos)
        nodes = self.graph["nodes"]
        if len(nodes) > MAX_STEPS:
            raise Unwanted(f"more than {MAX_STEPS} operators")
        steps = [step for node in nodes if not is_check(node["target"]) for step in [self._step(node)]]
        output = self._output()
        mark_spent(steps, {*range(len(weights) + 1), output})
        return Program(weights, steps, output, sizes), low, high

    def _inputs(self) -> tuple[list[Tensor], str]:
        """The weights in the order of their numbers, and the file's name for the pictures."""
        weights, photos = [], []
        for spec in self.module["signature"]["input_specs"]:
            kind, content = _only(spec)
            if kind == "user_input":
                photos.append(_only(content["arg"], "as_tensor")[1]["name"])
                continue
            if kind not in ("parameter", "buffer", "tensor_constant"):
                raise Unwanted(f"an input of kind {quoted(kind)}")
            kept = kind == "parameter" or (kind == "buffer" and content["persistent"] is not False)
            name = content[f"{kind}_name"]
            stored = self.tensors["weights" if kept else "constants"]
            if name not in stored:
                raise Unwanted(f"the weight {quoted(name)}, which it does not hold, or twice")
            self._new(content["arg"]["name"])
            weights.append(stored.pop(name))
        if len(photos) != 1:
            raise Unwanted(f"{len(photos)} inputs, not one of N×3×S×S")
        self._new(photos[0])
        return weights, photos[0]

    def _shape(self, photos: str) -> tuple[int, int, list[int | None]]:
        """The smallest and largest batch, and the input's sizes, None where any is allowed."""
        sizes = self.graph["tensor_values"][photos]["sizes"]
        if len(sizes) != 4:
            raise Unwanted(f"an input of {len(sizes)} dimensions, not N×3×S×S")
        fixed = [None if "as_expr" in size else whole(size["as_int"], 1, 1 << 16) for size in sizes]
        if fixed[0] is not None:
            low = high = whole(fixed[0], 1, MAX_BATCH)
        else:
            expression = sizes[0]["as_expr"]["expr_str"]
            symbol = _SYMBOL.fullmatch(expression)
            if not symbol:
                raise Unwanted(f"the shape {quoted(expression)} of its input, not any number of pictures")
            limits = self.ranges.get(symbol[1] or symbol[2], {})
            low, high = (limits.get(key) for key in ("min_val", "max_val"))
            low = whole(1 if low is None else max(1, whole(low, -_INT64, _INT64)), 1, MAX_BATCH)
            high = MAX_BATCH if high is None else min(MAX_BATCH, whole(high, low, _INT64))
        return low, high, [None, *fixed[1:]]

    def _output(self) -> int:
        """The number of the one output."""
        specs = self.module["signature"]["output_specs"]
        kinds = [_only(spec)[0] for spec in specs]
        if kinds != ["user_output"]:
            raise Unwanted(f"outputs {quoted(kinds)}, not one of N×K")
        return self._known(_only(_only(specs[0])[1]["arg"], "as_tensor")[1]["name"]).number

    def _step(self, node: dict[str, Any]) -> Step:
        target = node["target"]
        known = operator_named(target)
        if known is None:
            raise Unwanted(f"the operator {quoted(target)}")
        named = [(argument["name"], self._argument(argument["arg"])) for argument in node["inputs"]]
        arguments, keywords = _bound(named, known[1], target)
        several, results = self._results(node["outputs"])
        return Step(known[0], arguments, keywords, results, several, [])

    def _results(self, outputs: list[dict[str, Any]]) -> tuple[bool, list[int]]:
        """Whether the operator returns a sequence, and the new numbers of its items."""
        if len(outputs) == 1 and "as_tensors" in outputs[0]:
            return True, [self._new(item["name"]) for item in _few(outputs[0]["as_tensors"])]
        results = []
        for output in outputs:
            kind, content = _only(output, "as_tensor", "as_sym_int", "as_sym_float", "as_sym_bool", "as_none")
            name = None if kind == "as_none" else content["name"] if kind == "as_tensor" else content["as_name"]
            results.append(self._new(name))
        return len(results) != 1, results

    def _new(self, name: str | None) -> int:
        """The next number, for a name that is new; None is for what has no name."""
        if name is not None:
            if type(name) is not str or name in self.numbers:
                raise Unwanted(f"{quoted(name)} twice, or no name")
            self.numbers[name] = self.count
        self.count += 1
        return self.count - 1

    def _known(self, name: str) -> Value:
        if name not in self.numbers:
            raise Unwanted(f"{quoted(name)} before it is computed")
        return Value(self.numbers[name])

    def _argument(self, argument: dict[str, Any]) -> Any:
        """One argument of an operator: a value, a plain number or word, or a list of such."""
        kind, content = _only(argument)
        match kind:
            case "as_none":
                return None
            case "as_tensor":
                return self._known(content["name"])
            case "as_name":
                return self._known(content)
            case "as_tensors":
                return [self._known(item["name"]) for item in _few(content)]
            case "as_sym_int" | "as_sym_float" | "as_sym_bool" | "as_optional_tensor":
                return self._argument(content)
            case "as_sym_ints" | "as_sym_floats" | "as_sym_bools" | "as_optional_tensors":
                return [self._argument(item) for item in _few(content)]
            case "as_int":
                return whole(content, -_INT64, _INT64 - 1)
            case "as_ints" | "as_floats" | "as_bools":
                return [self._argument({kind[:-1]: item}) for item in _few(content)]
            case "as_float" if type(content) is float:
                return content
            case "as_float" if content in _FLOATS:
                return _FLOATS[content]
            case "as_bool" if type(content) is bool:
                return content
            case "as_string" if _WORD.fullmatch(content):
                return content
            case "as_scalar_type" if (dtype := DTYPES.get(whole(content, 0, 99))) is not None:
                return dtype
            case "as_memory_format" if (memory_format := _FORMATS.get(whole(content, 0, 99))) is not None:
                return memory_format
            case "as_layout" if content == STRIDED:
                return torch.strided
            case "as_device":
                return Here
        raise Unwanted(f"an argument of kind {quoted(kind)}, {quoted(content)}")


def _bound(named: list[tuple[str, Any]], schema: Sequence[Any] | None, target: str) -> tuple[list[Any], dict[str, Any]]:
    """Arguments as the operator's schema calls them: by place as long as none is left out, then by name."""
    if schema is None:
        return [value for _, value in named], {}
    given = dict(named)
    if len(given) != len(named) or given.get("train") is True or given.get("training") is True:
        raise Unwanted(f"the operator {quoted(target)} in training mode, or an argument twice")
    keywords = {argument.name: given.pop(argument.name) for argument in schema if argument.name in given}
    names = {argument.name for argument in schema}
    if "device" in names and not any(isinstance(argument.type, torch.TensorType) for argument in schema):
        keywords.setdefault("device", Here)  # new tensors lie where the pictures do
    if given:
        raise Unwanted(f"the argument {quoted(next(iter(given)))} of {target}")
    arguments = []
    for argument in schema:
        if argument.kwarg_only or argument.name not in keywords:
            break
        arguments.append(keywords.pop(argument.name))
    return arguments, keywords


def _only(union: dict[str, Any], *kinds: str) -> tuple[str, Any]:
    """The one entry of a table that says what it is by its key, and that is one of `kinds` where they are given."""
    if type(union) is not dict or len(union) != 1 or (kinds and not union.keys() <= set(kinds)):
        raise Unwanted(f"{quoted(union)} for {' or '.join(kinds) or 'an argument'}")
    return next(iter(union.items()))


def _few(items: list[Any]) -> list[Any]:
    if type(items) is not list or len(items) > MAX_LIST:
        raise Unwanted(f"a list of more than {MAX_LIST} items, or none")
    return items
