"""`file:NAME.pt2`: a network as a `torch.export` program, with NAME.json beside it.

The JSON says `input_px`, the side of the square that the program takes, and `labels`: a list, or the name of a JSON
file beside it that holds one. The program takes N×3×S×S sRGB in [0, 1], its normalization inside, and gives N×K logits.
A program exported for one batch size, or for a range of them, is called in such batches.
Nothing of the file is executed: archive.py reads tensors and JSON, description.py the graph from it, and graph.py
computes its operators, which are on the list in operators.py. torch's own loader, which writes names of the file into
Python, is not called.

To make one: `torch.export.save(torch.export.export(network.eval(), (torch.rand(2, 3, S, S),),
dynamic_shapes=({0: torch.export.Dim("n", min=1, max=4096)},)), "NAME.pt2")`.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import torch

from patchproof.classifier.archive import Unwanted, read_archive
from patchproof.classifier.batches import InBatches
from patchproof.classifier.description import read_program
from patchproof.classifier.network import Classifier
from patchproof.input import is_file, read_json
from patchproof.strict import Refused

MAX_BYTES = 4 << 30  # larger than any classifier here has been


def load_program(path: Path, device: torch.device | str = "cpu") -> Classifier:
    """The program and its card as a Classifier."""
    if path.suffix != ".pt2":
        do = "save it with torch.export.save as NAME.pt2, with NAME.json beside it"
        raise Refused("a torch.export program, file:NAME.pt2", f"{path}", do)
    if not is_file(path):
        raise Refused("a torch.export program", f"no file at {path}", "check the path")
    if path.stat().st_size > MAX_BYTES:
        got = f"{path}, which is larger"
        raise Refused(f"a program of at most {MAX_BYTES >> 30} GiB", got, "use a smaller network")
    input_px, labels = _card(path.with_suffix(".json"))
    stored = path.read_bytes()  # once, so that what is hashed is what is loaded
    network = _network(stored, path).to(device)
    return Classifier(f"file:{path}", hashlib.sha256(stored).hexdigest(), input_px, labels, network)


def _card(path: Path) -> tuple[int, tuple[str, ...]]:
    """Input size and labels."""
    do = 'write {"input_px": 224, "labels": ["...", ...]} into it, or the name of a JSON list beside it as labels'
    card = read_json(path, "a JSON file", do, do)
    input_px, labels = (card.get("input_px"), card.get("labels")) if isinstance(card, dict) else (None, None)
    if isinstance(labels, str):
        lay = "lay the list of labels there"
        labels = read_json(path.with_name(Path(labels).name), "a JSON file", lay, lay)
    if type(input_px) is not int or not 8 <= input_px <= 4096:
        raise Refused("input_px, a whole number of pixels from 8 to 4096", f"{input_px!r} in {path}", do)
    if not isinstance(labels, list) or len(labels) < 2 or not all(isinstance(label, str) for label in labels):
        raise Refused("labels, a list of two or more names", f"other labels in {path}", do)
    return input_px, tuple(labels)


def _network(stored: bytes, path: Path) -> InBatches:
    """The program as a function of any number of photographs."""
    try:
        return InBatches(*read_program(*read_archive(stored, path)))
    except Unwanted as error:
        raise Refused("a torch.export program of plain tensors and operators", f"{path} with {error}", _EVAL) from error
    except Refused:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        got = f"{path}, whose description cannot be read ({type(error).__name__})"
        raise Refused("a torch.export program", got, _AGAIN) from error


_EVAL = "export it in evaluation mode, without custom operators, control flow or tensor subclasses"
_AGAIN = "export it again with torch.export.save, torch 2.9 or later"
