"""`file:NAME.pt2`: a network as a `torch.export` program, with NAME.json beside it.

The JSON says `input_px`, the side of the square that the program takes, and `labels`: a list, or the name of a JSON
file beside it that holds one. The program takes N×3×S×S sRGB in [0, 1], its normalization inside, and gives N×K logits.
A program exported for one batch size, or for a range of them, is called in such batches.
No pickle and no code of the file is executed: see archive.py. As a second lock, unpicklers refuse to look anything up
while the program is read, so that a way in which nobody thought of ends in a refusal too.

To make one: `torch.export.save(torch.export.export(network.eval(), (torch.rand(2, 3, S, S),),
dynamic_shapes=({0: torch.export.Dim("n", min=1, max=4096)},)), "NAME.pt2")`.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import json
import logging
import pickle
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch import Tensor

from patchproof.classifier.archive import harmless_copy
from patchproof.classifier.batches import MAX_BATCH, InBatches
from patchproof.classifier.network import Classifier
from patchproof.strict import Refused

MAX_BYTES = 4 << 30  # larger than any classifier here has been


def load_program(path: Path, device: torch.device | str = "cpu") -> Classifier:
    """The program and its card as a Classifier."""
    if path.suffix != ".pt2":
        do = "save it with torch.export.save as NAME.pt2, with NAME.json beside it"
        raise Refused("a torch.export program, file:NAME.pt2", f"{path}", do)
    if not path.is_file():
        raise Refused("a torch.export program", f"no file at {path}", "check the path")
    if path.stat().st_size > MAX_BYTES:
        got = f"{path}, which is larger"
        raise Refused(f"a program of at most {MAX_BYTES >> 30} GiB", got, "use a smaller network")
    input_px, labels = _card(path.with_suffix(".json"))
    stored = path.read_bytes()  # once, so that what is hashed is what is loaded
    network = _network(harmless_copy(stored, path), path, device)
    return Classifier(f"file:{path}", hashlib.sha256(stored).hexdigest(), input_px, labels, network)


def _card(path: Path) -> tuple[int, tuple[str, ...]]:
    """Input size and labels."""
    do = 'write {"input_px": 224, "labels": ["...", ...]} into it, or the name of a JSON list beside it as labels'
    card = _read_json(path, do)
    input_px, labels = (card.get("input_px"), card.get("labels")) if isinstance(card, dict) else (None, None)
    if isinstance(labels, str):
        labels = _read_json(path.with_name(Path(labels).name), "lay the list of labels there")
    if type(input_px) is not int or not 8 <= input_px <= 4096:
        raise Refused("input_px, a whole number of pixels from 8 to 4096", f"{input_px!r} in {path}", do)
    if not isinstance(labels, list) or len(labels) < 2 or not all(isinstance(label, str) for label in labels):
        raise Refused("labels, a list of two or more names", f"other labels in {path}", do)
    return input_px, tuple(labels)


def _read_json(path: Path, do: str):
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise Refused(f"the JSON file {path}", "none", do) from None
    except (OSError, ValueError, RecursionError) as error:
        raise Refused("a JSON file", f"{path} that cannot be read ({error})", do) from error


def _network(copy: io.BytesIO, path: Path, device: torch.device | str) -> Callable[[Tensor], Tensor]:
    """The program as a function of any number of photographs."""
    try:
        with no_pickle(), _no_log():
            program = torch.export.load(copy)
            if torch.device(device).type != "cpu":
                from torch.export.passes import move_to_device_pass

                program = move_to_device_pass(program, device)
            module = program.module()
    except Exception as error:  # torch says "it cannot be read" in many types
        got = f"{path}, which torch {torch.__version__} cannot read ({type(error).__name__})"
        do = "export it again with this version of torch, or install the one it was exported with"
        raise Refused("a torch.export program", got, do) from error
    low, high = _batch_range(program)
    return InBatches(module, low, high)


def _batch_range(program: torch.export.ExportedProgram) -> tuple[int, int]:
    """The smallest and largest batch that the program's one input allows."""
    inputs = program.graph_signature.user_inputs
    nodes = [node for node in program.graph.nodes if node.op == "placeholder" and node.name in inputs]
    if len(nodes) != 1 or len(shape := nodes[0].meta["val"].shape) != 4:
        do = "export a network of one N×3×S×S input"
        raise Refused("a program of one N×3×S×S input", f"{len(nodes)} inputs or another shape", do)
    if isinstance(shape[0], int):
        return shape[0], shape[0]
    allowed = program.range_constraints.get(shape[0].node.expr)
    low, high = (allowed.lower, allowed.upper) if allowed else (1, MAX_BATCH)
    return max(1, int(low)), int(high) if high < MAX_BATCH else MAX_BATCH


_pickles = threading.local()


@contextlib.contextmanager
def no_pickle() -> Iterator[None]:
    """Inside, this thread's unpicklers may not look up a class or function: without one, a pickle can run nothing."""
    _watch_pickles()
    _pickles.shut = True
    try:
        yield
    finally:
        _pickles.shut = False


@functools.cache
def _watch_pickles() -> None:
    """Heed the audit event of every unpickler; a hook stays for good, so there is one, and it has a switch."""

    def hook(event: str, args: tuple) -> None:
        if event == "pickle.find_class" and getattr(_pickles, "shut", False):
            raise pickle.UnpicklingError(f"a pickle that asks for {args} is not executed")

    sys.addaudithook(hook)


@contextlib.contextmanager
def _no_log() -> Iterator[None]:
    """torch.export logs a page of traceback before it raises; the refusal says it in one sentence."""
    logger = logging.getLogger("torch.export")
    before = logger.disabled
    logger.disabled = True
    try:
        yield
    finally:
        logger.disabled = before
