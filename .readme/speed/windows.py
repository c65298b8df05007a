"""Gradients in windows beside whole ones: what they take, and how far they differ.

In: networks of DATA. Out: `windows.csv`: for windows of some shares of the picture's side, the medians of forward and
backward passes of two pictures, in turn and on one thread, with freed memory kept, and the largest difference of the
gradients in the windows, as a share of the largest gradient. Run in this folder, idle: python windows.py
"""

import csv
import os
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from patchproof.classifier import load_classifier
from patchproof.classifier.windows import Windows
from patchproof.workers import keep_freed_memory

NETWORKS = ("mobilenet_v2_1.0_224", "squeezenet1.1_224", "mobilenet_v1_0.75_192", "mobilenet_v1_0.25_128")
SHARES = (0.2, 0.3, 0.4, 0.5, 0.6, 0.8)
ROUNDS = 30


def gradient(network, photos, windows):
    """Of a weighted sum of the answers, at the pictures; and the milliseconds that it took."""
    leaf, start = photos.clone().requires_grad_(), time.perf_counter()
    answers = network(leaf, windows)
    weights = torch.linspace(-1, 1, answers.numel()).view(answers.shape)
    (found,) = torch.autograd.grad((answers * weights).sum(), leaf)
    return found, 1000 * (time.perf_counter() - start)


def measured(name: str, share: float) -> dict:
    """A line of the table."""
    classifier = load_classifier(f"file:{os.environ['PATCHPROOF_DATA']}/models/{name}.pt2", Path())
    network, size = classifier.network, classifier.input_px
    side, photos = round(share * size), torch.rand(2, 3, size, size)
    starts = np.random.default_rng(0).integers(0, size - side, (2, 2), endpoint=True)
    windows = np.hstack([starts, starts + side])
    times, difference = {"whole": [], "windows": []}, 0.0
    for _ in range(ROUNDS + 2):
        (whole, whole_ms), (parts, windows_ms) = (
            gradient(network, photos, None),
            gradient(network, photos, Windows(windows)),
        )
        times["whole"].append(whole_ms)
        times["windows"].append(windows_ms)
    for one, same, (left, top, right, bottom) in zip(parts, whole, windows.tolist(), strict=True):
        difference = max(difference, float((one - same)[:, top:bottom, left:right].abs().max()))
    whole_ms, windows_ms = (statistics.median(values[2:]) for values in times.values())  # the first are to warm up
    row = {"network": name, "share": share, "whole_ms": round(whole_ms, 2), "windows_ms": round(windows_ms, 2)}
    largest = float(whole.abs().max())
    return row | {"ratio": round(windows_ms / whole_ms, 3), "difference": f"{difference / largest:.1e}"}


if __name__ == "__main__":
    keep_freed_memory()
    torch.set_num_threads(1)
    torch.manual_seed(0)
    with open("windows.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, ("network", "share", "whole_ms", "windows_ms", "ratio", "difference"))
        writer.writeheader()
        for name in NETWORKS:
            for share in SHARES:
                writer.writerow(measured(name, share))
                file.flush()
