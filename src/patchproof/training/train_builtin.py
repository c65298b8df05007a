"""How the built-in network was made: `python -m patchproof.training.train_builtin --out DIR`.

In: nothing but seeds (pictures.py); a small convolutional network learns to name the objects. Out:
`builtin.safetensors` and `builtin.json` with the recipe, its seeds and the accuracy on shapes, textures and backgrounds
that training never saw.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from patchproof.classifier.builtin import INPUT_PX, SmallNetwork, folded
from patchproof.mesh import primitives
from patchproof.scene import patterns
from patchproof.training.card import by_class, stored, write_card
from patchproof.training.pictures import HELD_OUT, Pictures, augmented, pictures


@dataclass(frozen=True)
class Recipe:
    """Everything that decides the weights, but for the machine's rounding."""

    seed: int = 0
    pictures_per_class: int = 1500
    held_out_per_class: int = 200
    epochs: int = 20
    batch: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    label_smoothing: float = 0.1  # keeps the softmax off its ends, where gradients vanish
    pasted: float = 0.3  # share of training pictures with a card pasted on
    threads: int = 1


def main() -> None:
    """Render, train, measure, and write the network with its card."""
    parser = argparse.ArgumentParser(description="Train the built-in network from procedural renders.")
    parser.add_argument("--out", type=Path, required=True, help="folder for builtin.safetensors and builtin.json")
    for field in dataclasses.fields(Recipe):
        parser.add_argument(f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default)
    options = vars(parser.parse_args())
    out, recipe = options.pop("out"), Recipe(**options)
    torch.set_num_threads(recipe.threads)
    started = time.time()
    held_out = pictures(recipe.held_out_per_class, recipe.seed + HELD_OUT, INPUT_PX)
    training = pictures(recipe.pictures_per_class, recipe.seed, INPUT_PX)
    rendered = time.time()
    for epoch, loss, trained in train(training, recipe):
        shown = f", held out {accuracy(trained, held_out).mean():.3f}" if epoch % 4 == 3 else ""
        print(
            f"epoch {epoch + 1} of {recipe.epochs}: loss {loss:.3f}{shown}, {time.time() - started:.0f} s", flush=True
        )
        if epoch + 1 == recipe.epochs:
            seconds = {"render": round(rendered - started), "train": round(time.time() - rendered)}
            write(out, folded(trained.eval()), recipe, held_out, seconds)


def write(out: Path, network: torch.nn.Module, recipe: Recipe, held_out: Pictures, seconds: dict[str, int]) -> None:
    """The weights and what is known about them; the accuracy is that of the stored weights."""
    count = stored(network, out / "builtin.safetensors")
    right = accuracy(network, held_out)
    figures = {
        "input_px": INPUT_PX,
        "weights": count,
        "held_out_accuracy": round(float(right.mean()), 4),
        "held_out_accuracy_by_class": by_class(right),
    }
    write_card(out / "builtin.json", figures, "train_builtin", recipe, seconds)
    print(f"held-out accuracy {figures['held_out_accuracy']:.3f}: {figures['held_out_accuracy_by_class']}")


def train(shown: Pictures, recipe: Recipe) -> Iterator[tuple[int, float, SmallNetwork]]:
    """After each epoch: its number, its mean loss, and the network as it is."""
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng([recipe.seed, 1])
    network = SmallNetwork(len(primitives.names()), batch_norm=True).train()
    # a quarter faster on a CPU; torch's stubs do not know that a module takes this alone
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    steps = recipe.epochs * (len(shown.images) // recipe.batch)
    optimizer = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.learning_rate, total_steps=steps, pct_start=0.15)
    loss_of = torch.nn.CrossEntropyLoss(label_smoothing=recipe.label_smoothing)
    cards = torch.from_numpy(np.stack([patterns.card(rng) for _ in range(256)])).permute(0, 3, 1, 2)
    for epoch in range(recipe.epochs):
        losses = []
        order = torch.randperm(len(shown.images))
        for rows in order[: len(order) // recipe.batch * recipe.batch].split(recipe.batch):
            batch, _ = augmented(shown.images[rows], shown.boxes[rows], cards, rng, recipe.pasted)
            loss = loss_of(network(batch.contiguous(memory_format=torch.channels_last)), shown.labels[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
        yield epoch, float(np.mean(losses)), network


@torch.no_grad()
def accuracy(network: torch.nn.Module, shown: Pictures) -> np.ndarray:
    """Share of right answers, class by class."""
    was_training = network.training
    network.eval()
    right = torch.cat([network(batch.float() / 255).argmax(1) for batch in shown.images.split(256)]) == shown.labels
    network.train(was_training)
    return np.array(
        [right[shown.labels == label].float().mean().item() for label in range(int(shown.labels.max()) + 1)]
    )


if __name__ == "__main__":
    main()
