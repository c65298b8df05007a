"""Test the survival of hardened pictures under PGD, with one setting changed at a time.

    python src/patchlab/results/pgd/survival.py NAME NETWORK DIR...  measures, into src/patchlab/results/pgd/NAME.json
    python src/patchlab/results/pgd/survival.py draw                 draws src/patchlab/results/pgd.png from all of them

DIR are folders of labeled pictures (`labels.csv`), such as `python -m patchlab.training.labeled` writes. Pictures are
the network's own squares in 8 bits. One is lost as soon as the network is wrong on an attack's way. To begin with:
hardened by PGD in 40 steps within 0.04, attacked by PGD in 40 steps of ε/4 within 0.01 along the cross-entropy of the
true label, its gradient scaled (harden/attacks.py), from the picture itself.
"""

import csv
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.harden.attacks import balanced_loss, cross_entropy, is_correct, margin
from patchlab.harden.hardening import center_squares, harden
from patchproof.base.intervals import wilson
from patchproof.base.validation import expand_path
from patchproof.classifier.labels import find_labels
from patchproof.classifier.load import load_classifier
from patchproof.photo.read import read_photo

HERE = Path(__file__).parent
EPSILON, ATTACK, STEPS = 0.04, 0.01, 40
BALLS, REACHES = (0.01, 0.02, 0.04, 0.1), (0.001, 0.0025, 0.005, 0.01, 0.02)
WALKS = (10, 20, 40)  # steps of hardening without a ball
MEAN_STD = 0.226  # of the channels' standard deviations that ImageNet networks divide by
Gradient = Callable[[Tensor, Tensor], Tensor]


class Before:
    """Attacks before one network."""

    def __init__(self, network, labels: Tensor):
        self.network, self.labels = network, labels

    def right(self, pictures: Tensor) -> Tensor:
        """N bool."""
        with torch.no_grad():
            return is_correct(self.network(pictures), self.labels)

    def scaled(self, loss, x: Tensor, labels: Tensor) -> Tensor:
        """The gradient as ours: from float64 logits, scaled before it goes back."""
        x = x.detach().requires_grad_(True)
        return torch.autograd.grad(balanced_loss([self.network(x)], [labels], loss), x)[0]

    def plain(self, of_logits, x: Tensor, labels: Tensor) -> Tensor:
        """The gradient as torch gives it in float32."""
        x = x.detach().requires_grad_(True)
        loss = torch.nn.functional.cross_entropy(of_logits(self.network(x)), labels, reduction="sum")
        return torch.autograd.grad(loss, x)[0]

    def away(self, x: Tensor, labels: Tensor) -> Tensor:
        """Toward the class that was least likely for the unattacked picture, which `labels` names here."""
        return -self.scaled(cross_entropy, x, labels)

    def least(self, pictures: Tensor) -> Tensor:
        """N classes that are least likely."""
        with torch.no_grad():
            return self.network(pictures).argmin(1)

    def attacked(self, pictures, gradient: Gradient, epsilon=ATTACK, steps=STEPS, step=None, random=False, toward=None):
        """(lost pictures where they first were, others at the last step; N bool: never wrong)."""
        step = max(epsilon / 4, epsilon / steps) if step is None else step
        x, done = pictures.clone(), pictures.clone()
        alive = self.right(pictures)
        if random:
            seeded = torch.Generator().manual_seed(0)
            x = (x + torch.empty_like(x).uniform_(-epsilon, epsilon, generator=seeded)).clamp(0, 1)
        aim = self.labels if toward is None else toward
        for _ in range(steps):
            if not len(at := alive.nonzero()[:, 0]):
                break
            moved = x[at] + step * gradient(x[at], aim[at]).sign()
            x[at] = torch.clamp(moved, pictures[at] - epsilon, pictures[at] + epsilon).clamp(0, 1)
            done[at] = x[at]
            alive &= self.right(x)
        return done, alive

    def walked(self, pictures: Tensor, steps: int, step: float) -> Tensor:
        """Hardened in signed steps of one size, without a ball, then in 8 bits."""
        x = pictures
        for _ in range(steps):
            x = (x - step * self.scaled(cross_entropy, x, self.labels).sign()).clamp(0, 1)
        return (x * 255).round() / 255


def measured(name: str, folders: list[Path]) -> dict:
    """Everything of one network."""
    classifier = load_classifier(expand_path(name, Path.cwd()), Path.cwd())
    rows = [(folder, row) for folder in folders for row in csv.DictReader((folder / "labels.csv").open())]
    words = [row["label"] for _, row in rows]
    labels = [find_labels(classifier.labels, int(w) if w.isdigit() else w)[0] for w in words]
    views = center_squares([read_photo(folder / row["file"]).srgb for folder, row in rows], classifier)
    start = (views.clamp(0, 1) * 255).round() / 255
    before = Before(classifier.network, torch.tensor(labels))
    ours, at_margin = (partial(before.scaled, loss) for loss in (cross_entropy, margin))
    found: dict = {"network": name, "pictures": len(rows), "labels": words, "reach": {}, "settings": {}, "walks": {}}

    def hardened(pictures: Tensor, epsilon: float, method="pgd", steps=STEPS, through=None) -> Tensor:
        photos = list((pictures * 255).round().byte().permute(0, 2, 3, 1).numpy())
        pictures = harden(photos, [labels], [classifier], method, epsilon, steps, through=through)
        return center_squares(pictures, classifier)

    def keep(table: str, key: str, alive: Tensor, pictures: Tensor | None = None) -> None:
        kept = {"hits": "".join("01"[int(hit)] for hit in alive)}
        if pictures is not None:
            kept["rms"] = round(float((pictures - start).square().mean().sqrt()), 4)
        found[table][key] = kept
        print(table, key, f"{alive.double().mean():.3f}", kept.get("rms", ""), flush=True)

    by_ball = {0.0: start} | {epsilon: hardened(start, epsilon) for epsilon in BALLS}
    for ball, pictures in by_ball.items():
        keep("reach", f"{ball:g} at 0", before.right(pictures), pictures)
        for reach in REACHES:
            keep("reach", f"{ball:g} at {reach:g}", before.attacked(pictures, ours, reach)[1])
    hard = by_ball[EPSILON]
    with torch.no_grad():
        found["margins"] = {f"{b:g}": (-margin(before.network(p), before.labels)).tolist() for b, p in by_ball.items()}
    zero = [bool((g == 0).all()) for g in before.plain(lambda z: z, hard, before.labels)]
    found["zero gradients"] = sum(zero)

    for steps in (1, 2, 5, 10, 20):
        keep("settings", f"{steps} steps", before.attacked(hard, ours, steps=steps)[1])
    attacks = {
        "as it is": {},
        "steps of ε": {"step": ATTACK},
        "steps of ε/20": {"step": ATTACK / 20},
        "a random start": {"random": True},
        "steps of ε, a random start, plain float32": {
            "step": ATTACK,
            "random": True,
            "gradient": partial(before.plain, lambda z: z),
        },
        "plain float32 gradient": {"gradient": partial(before.plain, lambda z: z)},
        "softmax taken twice": {"gradient": partial(before.plain, lambda z: z.softmax(1))},
        "margin loss": {"gradient": at_margin},
        "toward the least likely class": {"gradient": before.away, "toward": before.least(hard)},
        "ε in normalized units": {"epsilon": ATTACK * MEAN_STD},
    }
    for key, changed in attacks.items():
        keep("settings", key, before.attacked(hard, **({"gradient": ours} | changed))[1])
    reached, _ = before.attacked(hard, ours)
    keep("settings", "kept in 8 bits", before.right((reached * 255).round() / 255))
    noise, _ = before.attacked(start, ours)
    keep("settings", "made on the original, added to the hardened", before.right((hard + noise - start).clamp(0, 1)))
    keep("settings", "hardened after the attack", before.right(hardened(noise.clamp(0, 1), EPSILON)))
    one = hardened(start, EPSILON, "fgsm", 1)
    keep("settings", "hardened in one step", before.attacked(one, ours)[1], one)
    for ball in (EPSILON, 0.1):
        pictures = hardened(start, ball, through=ATTACK)
        keep("reach", f"{ball:g} through at 0", before.right(pictures), pictures)
        for reach in REACHES:
            keep("reach", f"{ball:g} through at {reach:g}", before.attacked(pictures, ours, reach)[1])
        for key, gradient in (("cross-entropy", ours), ("margin loss", at_margin)):
            alive = before.attacked(pictures, gradient, steps=100, step=ATTACK / 10, random=True)[1]
            keep("settings", f"{ball:g} through the attack, 100 steps of ε/10 from a random start, {key}", alive)
    for steps in WALKS:
        for step in (0.01, 0.04):
            walked = before.walked(start, steps, step)
            keep("walks", f"{steps} of {step:g}", before.attacked(walked, ours, step)[1], walked)
    return found


TITLES = {"mobilenet": "MobileNet v1 0.25", "builtin": "built-in network"}
LINES = ("0", "0.01", "0.02", "0.04", "0.1", "0.04 through", "0.1 through")
OTHERWISE = (  # than 40 steps of ε/4 of the scaled cross-entropy's gradient, from the hardened picture
    *("1 steps", "5 steps", "10 steps", "20 steps", "as it is"),
    *("steps of ε", "steps of ε/20", "a random start", "plain float32 gradient"),
    "steps of ε, a random start, plain float32",
    *("softmax taken twice", "margin loss", "toward the least likely class", "kept in 8 bits"),
    *("hardened in one step", "ε in normalized units", "made on the original, added to the hardened"),
    "hardened after the attack",
)


def rate(found: dict, table: str, key: str) -> tuple[float, float, float]:
    """Share that survives with its interval: Wilson's, since pictures are of different shapes and photographs."""
    hits = found[table][key]["hits"]
    return hits.count("1") / len(hits), *wilson(hits.count("1"), len(hits))


def draw() -> None:
    """One column a network: by the attack's reach, and by what else is changed."""
    from matplotlib.figure import Figure

    figure = Figure((11, 8.4), layout="constrained")
    plots = figure.subplots(2, len(TITLES), height_ratios=(1, 1.25), squeeze=False)
    for column, (name, title) in enumerate(TITLES.items()):
        found = json.loads((HERE / f"{name}.json").read_text(encoding="utf-8"))
        curves, bars = plots[:, column]
        for number, ball in enumerate(LINES):
            values = np.array([rate(found, "reach", f"{ball} at {reach:g}") for reach in REACHES])
            color, line = f"C{LINES.index(ball.split()[0])}", "--" if "through" in ball else "-"
            label = "original" if ball == "0" else f"hardened within {ball.replace(' through', ', through the attack')}"
            curves.plot(np.array(REACHES) * 1.015 ** (number - 3), values[:, 0], f"o{line}", color=color, label=label)
            curves.vlines(np.array(REACHES) * 1.015 ** (number - 3), values[:, 1], values[:, 2], color=color, alpha=0.5)
        curves.set(xscale="log", xlabel="ε of the attack (PGD, 40 steps)", ylabel="recognized under attack")
        curves.set_xticks(REACHES, [f"{reach:g}" for reach in REACHES], minor=False)
        curves.set_title(f"{title}, {found['pictures']} pictures", fontsize=10)
        values = np.array([rate(found, "settings", key) for key in OTHERWISE])
        rows = np.arange(len(OTHERWISE))[::-1]
        bars.barh(rows, values[:, 0], color="C3", height=0.6)
        bars.hlines(rows, values[:, 1], values[:, 2], color="black", linewidth=1)
        words = [key.replace("as it is", "40 steps of ε/4: as it is").replace("1 steps", "1 step") for key in OTHERWISE]
        bars.set_yticks(rows, words if column == 0 else [""] * len(words), fontsize=8)
        bars.set(xlim=(0, 1), xlabel="recognized; hardened within 0.04, ε of the attack 0.01")
    handles = plots[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper center", ncols=4, fontsize=8, frameon=False)
    figure.savefig(HERE.parent / "pgd.png", dpi=100)


if __name__ == "__main__":
    torch.set_num_threads(1)
    if sys.argv[1:] == ["draw"]:
        draw()
    else:
        name, network, *folders = sys.argv[1:]
        found = measured(network, [Path(folder) for folder in folders])
        (HERE / f"{name}.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
