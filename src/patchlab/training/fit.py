"""Train a network on rendered pictures, from the command line to its files; shared by all built-in networks.

In: a recipe, and functions that build, train, score and write a network. Out: the written network, and printed
progress. Rendered pictures can be stored in a folder for later trainings.
"""

import argparse
import copy
import dataclasses
import datetime
import json
import platform
import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor, nn

from patchlab.training.pictures import HELD_OUT_SEED, Pictures, load_or_render, render_pictures
from patchproof.mesh import primitives
from patchproof.scene import patterns

Epochs = Iterator[tuple[int, float, nn.Module]]  # after each epoch: its number, its mean loss, the network
HELD_OUT_TEXT = "renders of other shapes, textures, backgrounds and conditions of the same kinds; nothing real"


@dataclass(frozen=True)
class TrainingRecipe:
    """Everything that determines the weights, up to the machine's rounding."""

    seed: int = 0
    pictures_per_class: int = 1500
    held_out_per_class: int = 200
    epochs: int = 20
    batch: int = 64
    learning_rate: float = 2e-3
    weight_decay: float = 0.02
    pasted: float = 0.3  # share of training pictures with a pasted card
    threads: int = 1


RecipeType = TypeVar("RecipeType", bound=TrainingRecipe)


class Seconds(NamedTuple):
    """Seconds that the parts of a training took."""

    render: int
    train: int


def run(
    make: type[RecipeType],
    about: str,
    input_px: int,
    train: Callable[[Pictures, RecipeType], Epochs],
    score: Callable[[nn.Module, Pictures], np.ndarray],
    write: Callable[[Path, nn.Module, RecipeType, Pictures, Seconds], None],
    prepare: Callable[[Pictures, RecipeType], Pictures] = lambda rendered, recipe: rendered,
) -> None:
    """Run the command: render at `input_px`, train, print the mean of `score` every fourth epoch, and write the
    network; `prepare` turns rendered pictures into the network's input.
    """
    out, folder, recipe = _parse_options(make, about)
    torch.set_num_threads(recipe.threads)
    started = time.time()
    render = render_pictures if folder is None else lambda *what: load_or_render(folder, *what)
    held_out = prepare(render(recipe.held_out_per_class, recipe.seed + HELD_OUT_SEED, input_px), recipe)
    training = prepare(render(recipe.pictures_per_class, recipe.seed, input_px), recipe)
    rendered = time.time()
    for epoch, loss, network in train(training, recipe):
        score_text = f", held out {score(network, held_out).mean():.3f}" if epoch % 4 == 3 else ""
        print(
            f"epoch {epoch + 1} of {recipe.epochs}: loss {loss:.3f}{score_text}, {time.time() - started:.0f} s",
            flush=True,
        )
        if epoch + 1 == recipe.epochs:
            seconds = Seconds(round(rendered - started), round(time.time() - rendered))
            write(out, network.eval(), recipe, held_out, seconds)


def _parse_options(make: type[RecipeType], about: str) -> tuple[Path, Path | None, RecipeType]:
    parser = argparse.ArgumentParser(description=about)
    parser.add_argument("--out", type=Path, required=True, help="folder for the weights and their card")
    parser.add_argument("--pictures", type=Path, help="folder that keeps the rendered pictures for further trainings")
    for field in dataclasses.fields(make):
        parser.add_argument(f"--{field.name.replace('_', '-')}", type=type(field.default), default=field.default)
    options = vars(parser.parse_args())
    return options.pop("out"), options.pop("pictures"), make(**options)


def train_epochs(
    make: Callable[[], nn.Module],
    pictures: Pictures,
    recipe: TrainingRecipe,
    loss_of: Callable[[nn.Module, Tensor, Tensor, np.random.Generator], Tensor],
) -> Epochs:
    """Train by `loss_of(network, rows of the pictures, cards to paste, generator)`; yields after each epoch."""
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng([recipe.seed, 1])
    network = make().train()
    # a quarter faster on a CPU; torch's stubs do not know that a module takes this alone
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    steps = recipe.epochs * (len(pictures.images) // recipe.batch)
    optimizer = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.learning_rate, total_steps=steps, pct_start=0.15)
    cards = torch.from_numpy(np.stack([_draw_card(rng) for _ in range(256)])).permute(0, 3, 1, 2)
    for epoch in range(recipe.epochs):
        losses, order = [], torch.randperm(len(pictures.images))
        for rows in order[: len(order) // recipe.batch * recipe.batch].split(recipe.batch):
            loss = loss_of(network, rows, cards, rng)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
        yield epoch, float(np.mean(losses)), network


def _draw_card(rng: np.random.Generator, px: int = 40) -> np.ndarray:
    """Draw a card P×P×3 float32 in [0, 1]: a texture, mostly framed by white paper with black blocks."""
    picture = patterns.texture(rng, px)
    if rng.random() < 0.6:
        margin, cell = int(rng.integers(4, 9)), int(rng.integers(2, 4))
        blocks = rng.random((px // cell + 1, px // cell + 1)) < rng.uniform(0.2, 0.6)
        blocks = blocks.repeat(cell, 0).repeat(cell, 1)[:px, :px, None]
        frame = np.where(blocks, 0.08, 0.95).repeat(3, 2)
        frame[margin:-margin, margin:-margin] = picture[margin:-margin, margin:-margin]
        picture = frame
    return picture.astype(np.float32)


def fold_batch_norm(trained: nn.Module) -> nn.Module:
    """A copy without BatchNorm, whose scale and shift (of evaluation) are folded into the convolutions."""
    plain = copy.deepcopy(trained).eval()
    for parent in list(plain.modules()):
        for name, child in list(parent.named_children()):
            if isinstance(child, nn.Sequential):  # a convolution and its norm, as the built-in networks join them
                conv_and_norm: list[Any] = list(child.children())
                parent.register_module(name, torch.nn.utils.fuse_conv_bn_eval(*conv_and_norm))
    return plain


def class_names() -> list[str]:
    """Labels of the procedural objects, with spaces in place of underscores."""
    return [name.replace("_", " ") for name in primitives.primitive_names()]


def store_float16(network: nn.Module, path: Path) -> int:
    """Write the weights as float16, load them back into the network, and return their number."""
    from safetensors.torch import save_file

    path.parent.mkdir(parents=True, exist_ok=True)
    weights = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    save_file(weights, path)
    network.load_state_dict({name: tensor.float() for name, tensor in weights.items()})
    return sum(tensor.numel() for tensor in weights.values())


def export_onnx(network: nn.Module, path: Path, input_px: int) -> int:
    """Write the network as an ONNX file for batches of any size, and return the number of weights."""
    path.parent.mkdir(parents=True, exist_ok=True)
    photos, any_number = torch.rand(2, 3, input_px, input_px), {0: torch.export.Dim("n", max=99)}
    options: dict[str, Any] = {"dynamo": True, "external_data": False, "verbose": False}
    torch.onnx.export(network.eval(), (photos,), path, dynamic_shapes=(any_number,), **options)
    return sum(weights.numel() for weights in network.parameters())


def write_card(path: Path, figures: dict[str, Any], module: str, recipe: TrainingRecipe, seconds: Seconds) -> None:
    """Write the labels, the figures and the command that makes the network again."""
    changed = [field for field in dataclasses.fields(recipe) if getattr(recipe, field.name) != field.default]
    options = [f"--{field.name.replace('_', '-')} {shlex.quote(str(getattr(recipe, field.name)))}" for field in changed]
    card = {
        "labels": class_names(),
        **figures,
        "held_out": HELD_OUT_TEXT,
        "command": " ".join([f"python -m patchlab.training.{module} --out DIR", *options]),
        "recipe": dataclasses.asdict(recipe),
        "seconds": seconds._asdict(),
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, torch {torch.__version__}, {recipe.threads} thread(s)",
    }
    path.write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")


def round_by_class(figures: Any) -> dict[str, float]:
    """By class name a figure, rounded to four digits."""
    return {name: round(float(figure), 4) for name, figure in zip(class_names(), figures, strict=True)}
