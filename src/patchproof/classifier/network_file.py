"""`file:NAME.onnx`: a network as an ONNX file, with NAME.json beside it.

The JSON holds `input_px`, the side of the square that the network takes, and `labels`: a list, or the name of a JSON
file beside it that holds one. The network takes N×3×S×S sRGB in [0, 1], its normalization inside, and gives N×K logits;
with `"kind": "detector"` in the JSON, candidates N×A×(4+K), boxes in pixels before the logits (detector.py), or
what the head in `"head"` gives (heads.py).
Nothing of the file is executed: protobuf.py reads its fields, onnx_file.py the graph from them, and graph.py computes
its operators, which are on the list in onnx_operators.py. Weights may lie in files beside it that NAME.onnx names.
"""

import hashlib
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from patchproof.base.errors import Refused
from patchproof.base.input import read_file, read_json
from patchproof.base.validation import summarize_names
from patchproof.classifier.detector import Detector
from patchproof.classifier.head_decoder import HeadDecoder
from patchproof.classifier.heads import Head, head_of
from patchproof.classifier.network import INPUT_PX, Classifier
from patchproof.networks.batches import BatchedNetwork
from patchproof.networks.bounds import UnsupportedNetwork, quote
from patchproof.networks.onnx_file import read_onnx

MAX_BYTES = 4 << 30  # larger than any classifier tested
EXPORT_ADVICE = (
    'export it with torch.onnx.export(network.eval(), (torch.rand(2, 3, S, S),), "NAME.onnx", '
    'dynamic_shapes=({0: torch.export.Dim("n", max=99)},), dynamo=True), S pixels a side, and put NAME.json beside it'
)


def load_network(path: str | Path) -> Classifier:
    """The ONNX file and its card as a Classifier; other kinds of files are refused by their suffix."""
    if (path := Path(path)).suffix != ".onnx":
        raise Refused("a network as an ONNX file, file:NAME.onnx", f"{path}", EXPORT_ADVICE)
    stored = network_bytes(path)  # read once, so that the hash is of the bytes that are loaded
    card = read_card(path.with_suffix(".json"))
    digest, other_bytes = hashlib.sha256(stored), len(stored)
    digest.update(card.head.model_dump_json().encode() if card.head else b"")  # its answers depend on it
    is_detector = card.kind == Detector.KIND
    join = HeadDecoder(f"file:{path}", len(card.labels), card.input_px, card.head) if is_detector else None

    def read_data(location: str) -> bytes:
        nonlocal other_bytes
        data = network_bytes(_beside(path, location), f"put {location} beside {path.name}, which names it", other_bytes)
        other_bytes += len(data)
        digest.update(data)
        return data

    try:
        program, batch, metadata = read_onnx(stored, read_data, join)
    except UnsupportedNetwork as error:
        do = "export it in evaluation mode, without custom operators and control flow, opset_version=18"
        raise Refused("an ONNX file of plain tensors and operators", f"{path} with {error}", do) from error
    except Refused:
        raise
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError) as error:
        got = f"{path}, whose description cannot be read ({type(error).__name__})"
        raise Refused("an ONNX file", got, "export it again with torch.onnx.export") from error
    check_entries(metadata, path)
    make = Detector if is_detector else Classifier
    return make(f"file:{path}", digest.hexdigest(), card.input_px, card.labels, BatchedNetwork(program, batch))


def _beside(path: Path, location: str) -> Path:
    """The file of weights that an ONNX file names; refused unless it lies in the same folder."""
    location = location.removeprefix("./")
    beside = path.parent / location
    is_named = location not in ("", ".", "..") and not set("/\\:\0") & set(location)
    if not is_named or os.path.dirname(os.path.realpath(beside)) != os.path.realpath(path.parent):
        do = 'save it again with onnx.save(..., save_as_external_data=True, location="NAME.onnx.data")'
        raise Refused("weights in a file beside the network", f"{quote(location)} named in {path}", do)
    return beside


def network_bytes(path: Path, do: str = "check the path", other_bytes: int = 0) -> bytes:
    """Read a file of a network; refused if it is missing or, with the network's other files, beyond `MAX_BYTES`."""
    return read_file(path, "a network", do, MAX_BYTES - other_bytes)


# words at the end of a key, by which pictures are prepared, and what they say of sRGB in [0, 1]
_PREPARED = {
    r"means?|mean_values": r"\W*0(\.0*)?(, *0(\.0*)?)*\W?",
    r"stds?|std_values|scale_values": r"\W*1(\.0*)?(, *1(\.0*)?)*\W?",
    r"channels?|channel_order|color_?(space|mode|format)|BitmapPixelFormat|layout": r"3|s?rgb8?|n?chw",
    r"NominalPixelRange|range|ColorSpaceGamma": r"srgb|normalized_0_1|\W?0(\.0*)?, *1(\.0*)?\W?",
    r"bgr|normali[sz](e|ation)|preprocess(ing)?|do_\w+": r"false|no|none|0",
}
_DESCRIPTIONS = "name|description|source|url|docs|version|licen[cs]e|author|date|format"
_CARD_NOTES = "(?!.*(resize|crop|interpol|thresh|activation|softmax|sigmoid)).*"  # a card may hold any notes but these


def check_entries(entries: Mapping[str, Any], source: Path, notes: str = _DESCRIPTIONS) -> None:
    """Refuse entries of a card, or of a file's metadata, by which pictures are anything but sRGB in [0, 1]; warn of
    others unless their keys match `notes`.
    """
    unused = []
    for key, value in ((key[:60], value) for key, value in entries.items()):
        text = f"{key} = {quote(value)}"
        harmless = [values for words, values in _PREPARED.items() if re.fullmatch(rf"(.*[._ ])?({words})", key, re.I)]
        if harmless and not re.fullmatch(harmless[0], str(value), re.I):
            do = "prepare the pictures inside of the network, export it again, and remove this entry"
            raise Refused("a network that takes sRGB in [0, 1]", f"{text} in {source}", do)
        if not harmless and not re.fullmatch(notes, key, re.I):
            unused.append(text)
    if unused:
        warnings.warn(f"{source} says what is not used: {summarize_names(unused)}", stacklevel=2)


class Card(NamedTuple):
    """The contents of the JSON file beside a network."""

    input_px: int
    labels: tuple[str, ...]
    kind: str
    head: Head | None = None  # of a detector, where the JSON says


def read_card(path: Path) -> Card:
    """Read the JSON file beside a network."""
    do = 'write {"input_px": 224, "labels": ["...", ...]} into it, or the name of a JSON list beside it as labels'
    card = read_json(path, "a JSON file", do, do)
    input_px, labels = (card.get("input_px"), card.get("labels")) if isinstance(card, dict) else (None, None)
    if isinstance(labels, str):
        advice = "put the list of labels there"
        labels = read_json(path.parent / Path(labels).name, "a JSON file", advice, advice)
    if type(input_px) is not int or input_px not in INPUT_PX:
        raise Refused("input_px, a whole number of pixels from 8 to 4096", f"{input_px!r} in {path}", do)
    kind = card.get("kind", Detector.KIND if "head" in card else Classifier.KIND)
    if kind not in (Classifier.KIND, Detector.KIND):
        raise Refused(f'kind, "{Classifier.KIND}" or "{Detector.KIND}"', f"{kind!r} in {path}", "write one of these")
    least, word = (1, "one") if kind == Detector.KIND else (2, "two")
    if not isinstance(labels, list) or len(labels) < least or {*map(type, labels)} != {str}:
        raise Refused(f"labels, a list of {word} or more names", f"{str(labels)[:60]} in {path}", do)
    check_entries(card, path, _CARD_NOTES)
    return Card(input_px, tuple(labels), kind, head_of(card["head"], str(path)) if "head" in card else None)
