"""Gradients in windows, and answers to pictures that differ in them, beside whole ones: what they take, how far off.

In: networks of DATA. Out: `windows.csv`: for windows of some shares of the picture's side, the medians of forward and
backward passes of two pictures and of forward passes of four beside four others, in turn with whole passes and on one
thread, with freed memory kept; and the largest differences, of gradients in the windows as a share of the largest
gradient, of logits as they are. Run in this folder, idle: python windows.py
"""

import os
import statistics
from functools import partial
from pathlib import Path
from time import perf_counter

import numpy as np
import torch

from patchlab.results.rows import write_rows
from patchlab.study.measure import call_in_turn, time_call
from patchproof.base.workers import keep_freed_memory
from patchproof.classifier import load_classifier
from patchproof.networks.batches import Windows

NETWORKS = ("mobilenet_v2_1.0_224", "squeezenet1.1_224", "mobilenet_v1_0.75_192", "mobilenet_v1_0.25_128")
SHARES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8)
ROUNDS = 30


def gradient(network, photos, windows):
    """The gradient of a weighted sum of the answers at the pictures."""
    leaf = photos.clone().requires_grad_()
    answers = network(leaf, windows)
    weights = torch.linspace(-1, 1, answers.numel()).view(answers.shape)
    return torch.autograd.grad((answers * weights).sum(), leaf)[0]


def in_turn_ms(whole, some):
    """(what both calls return in each round, their median milliseconds)."""
    calls = {call: partial(time_call, call, perf_counter) for call in (whole, some)}
    answers, times = zip(*(zip(*each, strict=True) for each in call_in_turn(calls, ROUNDS).values()), strict=True)
    return list(zip(*answers, strict=True)), [statistics.median(ms) for ms in times]


def placed(size: int, share: float, count: int) -> np.ndarray:
    """Windows of that share of the side, anywhere."""
    side = round(share * size)
    starts = np.random.default_rng(0).integers(0, size - side, (count, 2), endpoint=True)
    return np.hstack([starts, starts + side])


def parts(photos, windows):
    """The window of each picture."""
    edges = windows.tolist()
    return [one[:, top:bottom, left:right] for one, (left, top, right, bottom) in zip(photos, edges, strict=True)]


def asked_for_gradients(network, size: int, share: float) -> dict:
    """Compare gradients of two pictures in their windows with whole gradients."""
    windows, photos = placed(size, share, 2), torch.rand(2, 3, size, size)
    calls = (partial(gradient, network, photos, w) for w in (None, Windows(windows)))
    ((whole, some), *_), (whole_ms, windows_ms) = in_turn_ms(*calls)
    largest = float(whole.abs().max())
    pairs = zip(parts(some, windows), parts(whole, windows), strict=True)
    difference = max(float((one - same).abs().max()) for one, same in pairs) / largest
    row = {"whole_ms": round(whole_ms, 2), "windows_ms": round(windows_ms, 2)}
    return row | {"ratio": round(windows_ms / whole_ms, 3), "difference": f"{difference:.1e}"}


@torch.no_grad()
def asked_beside_others(network, size: int, share: float) -> dict:
    """Four pictures that differ in windows only from four others, whose answers are known."""
    windows, photos = placed(size, share, 4), torch.rand(4, 3, size, size)
    others, kept = photos.clone(), {}
    for part in parts(others, windows):
        part.uniform_()
    network(photos, Windows(windows, kept))
    calls = (partial(network, others, known) for known in (None, Windows(windows, kept)))
    told, (whole_ms, beside_ms) = in_turn_ms(*calls)
    difference = max(float((whole - beside).abs().max()) for whole, beside in told)
    row = {"forward_ms": round(whole_ms, 2), "beside_ms": round(beside_ms, 2)}
    return row | {"beside_ratio": round(beside_ms / whole_ms, 3), "beside_difference": f"{difference:.1e}"}


def measured(name: str, share: float) -> dict:
    """A line of the table."""
    classifier = load_classifier(f"file:{os.environ['PATCHPROOF_DATA']}/models/{name}.onnx", Path())
    asked = classifier.network, classifier.input_px, share
    return {"network": name, "share": share, **asked_for_gradients(*asked), **asked_beside_others(*asked)}


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    write_rows("windows.csv", (measured(name, share) for name in NETWORKS for share in SHARES))
