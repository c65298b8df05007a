"""How the built-in network was made: `python -m patchproof.training.train_builtin --out DIR`.

In: nothing but seeds. Our own renderer shows our own procedural objects with drawn shapes, colors, textures, poses,
lights, cameras and backgrounds; a small convolutional network learns to name them. Out: `builtin.safetensors` and
`builtin.json` with the recipe, its seeds and the accuracy on shapes, textures and backgrounds that training never saw.
Half of the pictures are rendered at the network's size, as in training a patch, half at twice the size and then
reduced, as a photograph is.
Left out on purpose: anything real. The network serves demos and tests and says nothing of photographs of real objects.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import json
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchproof.classifier.builtin import INPUT_PX, SmallNetwork, folded
from patchproof.classifier.network import center_square
from patchproof.color import codes_of
from patchproof.mesh import primitives
from patchproof.mesh.mesh import Mesh
from patchproof.render.photograph import photograph
from patchproof.render.stage import set_stage
from patchproof.scene import patterns
from patchproof.scene.backgrounds import Backgrounds
from patchproof.scene.mesh_scene import bare_scene
from patchproof.settings import SceneSettings
from patchproof.strict import validated

LENGTH_MM = 300.0
PHOTO_PX = 2 * INPUT_PX
VIEWS_PER_SHAPE = 10
HELD_OUT = 1_000_000  # seeds from here on are never trained on


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
    held_out = pictures(recipe.held_out_per_class, recipe.seed + HELD_OUT)
    training = pictures(recipe.pictures_per_class, recipe.seed)
    rendered = time.time()
    for epoch, loss, trained in train(*training, recipe):
        shown = f", held out {accuracy(trained, *held_out).mean():.3f}" if epoch % 4 == 3 else ""
        print(
            f"epoch {epoch + 1} of {recipe.epochs}: loss {loss:.3f}{shown}, {time.time() - started:.0f} s", flush=True
        )
        if epoch + 1 == recipe.epochs:
            seconds = {"render": round(rendered - started), "train": round(time.time() - rendered)}
            write(out, folded(trained.eval()), recipe, held_out, seconds)


def write(out: Path, network: SmallNetwork, recipe: Recipe, held_out: tuple[Tensor, Tensor], seconds: dict) -> None:
    """The weights as float16, and what is known about them; the accuracy is that of the stored weights."""
    from safetensors.torch import save_file

    out.mkdir(parents=True, exist_ok=True)
    stored = {name: tensor.half().contiguous() for name, tensor in network.state_dict().items()}
    save_file(stored, out / "builtin.safetensors")
    network.load_state_dict({name: tensor.float() for name, tensor in stored.items()})
    by_class = accuracy(network, *held_out)
    names = [name.replace("_", " ") for name in primitives.names()]
    card = {
        "classes": names,
        "input_px": INPUT_PX,
        "weights": sum(tensor.numel() for tensor in stored.values()),
        "held_out_accuracy": round(float(by_class.mean()), 4),
        "held_out_accuracy_by_class": {n: round(float(a), 4) for n, a in zip(names, by_class, strict=True)},
        "held_out": "renders of other shapes, textures, backgrounds and conditions of the same kinds; nothing real",
        "command": "python -m patchproof.training.train_builtin --out DIR",
        "recipe": dataclasses.asdict(recipe),
        "seconds": seconds,
        "date": datetime.date.today().isoformat(),
        "machine": f"{platform.machine()}, torch {torch.__version__}, {recipe.threads} thread(s)",
    }
    (out / "builtin.json").write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    print(f"held-out accuracy {card['held_out_accuracy']:.3f}: {card['held_out_accuracy_by_class']}")


# ---------------------------------------------------------------------------------------------------- training


def train(images: Tensor, labels: Tensor, recipe: Recipe) -> Iterator[tuple[int, float, SmallNetwork]]:
    """After each epoch: its number, its mean loss, and the network as it is."""
    torch.manual_seed(recipe.seed)
    rng = np.random.default_rng([recipe.seed, 1])
    network = SmallNetwork(len(primitives.names()), batch_norm=True).train()
    # a quarter faster on a CPU; torch's stubs do not know that a module takes this alone
    network.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
    steps = recipe.epochs * (len(images) // recipe.batch)
    optimizer = torch.optim.AdamW(network.parameters(), recipe.learning_rate, weight_decay=recipe.weight_decay)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, recipe.learning_rate, total_steps=steps, pct_start=0.15)
    loss_of = torch.nn.CrossEntropyLoss(label_smoothing=recipe.label_smoothing)
    cards = torch.from_numpy(np.stack([patterns.card(rng) for _ in range(256)])).permute(0, 3, 1, 2)
    for epoch in range(recipe.epochs):
        losses = []
        order = torch.randperm(len(images))
        for rows in order[: len(order) // recipe.batch * recipe.batch].split(recipe.batch):
            batch = augmented(images[rows], cards, rng, recipe.pasted)
            loss = loss_of(network(batch.contiguous(memory_format=torch.channels_last)), labels[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            losses.append(loss.item())
        yield epoch, float(np.mean(losses)), network


def augmented(images: Tensor, cards: Tensor, rng: np.random.Generator, pasted: float) -> Tensor:
    """uint8 pictures as [0, 1] floats: mirrored, shifted, scaled and tinted, and some with a card pasted on."""
    n = len(images)
    x = images.float() / 255
    side = rng.uniform(0.75, 1.1, n)
    shift = rng.uniform(-1, 1, (2, n)) * np.maximum(1 - side, 0.05)
    matrix = np.zeros((n, 2, 3), np.float32)
    matrix[:, 0, 0], matrix[:, 1, 1] = side * rng.choice([-1, 1], n), side
    matrix[:, :, 2] = shift.T
    grid = torch.nn.functional.affine_grid(torch.from_numpy(matrix), list(x.shape), align_corners=False)
    x = torch.nn.functional.grid_sample(x, grid, padding_mode="border", align_corners=False)
    gain = torch.from_numpy(np.exp(rng.normal(0, [[0.25], [0.07], [0.07], [0.07]], (4, n))).astype(np.float32))
    x = (x - 0.45) * gain[0, :, None, None, None] + 0.45
    x = (
        x * gain[1:].T[:, :, None, None] + torch.from_numpy(rng.normal(0, 0.05, (n, 1, 1, 1)).astype(np.float32))
    ).clamp(0, 1)
    for i in np.flatnonzero(rng.random(n) < pasted):
        height, width = (int(v) for v in rng.integers(12, 44, 2))
        top, left = int(rng.integers(0, INPUT_PX - height)), int(rng.integers(0, INPUT_PX - width))
        card = cards[int(rng.integers(len(cards)))][None]
        x[i, :, top : top + height, left : left + width] = torch.nn.functional.interpolate(
            card, (height, width), mode="bilinear", antialias=True
        )[0] * float(rng.uniform(0.4, 1.0))
    return x


@torch.no_grad()
def accuracy(network: SmallNetwork, images: Tensor, labels: Tensor) -> np.ndarray:
    """Share of right answers, class by class."""
    was_training = network.training
    network.eval()
    right = torch.cat([network(batch.float() / 255).argmax(1) for batch in images.split(256)]) == labels
    network.train(was_training)
    return np.array([right[labels == label].float().mean().item() for label in range(int(labels.max()) + 1)])


# ---------------------------------------------------------------------------------------------------- pictures


def pictures(per_class: int, seed: int) -> tuple[Tensor, Tensor]:
    """uint8 N×3×96×96 and labels N: every shape is seen from VIEWS_PER_SHAPE drawn conditions."""
    images, labels = [], []
    for label, name in enumerate(primitives.names()):
        for shape in range(-(-per_class // VIEWS_PER_SHAPE)):
            rng = np.random.default_rng([seed, label, shape])
            images.append(_views(name, seed + shape, rng))
            labels += [label] * VIEWS_PER_SHAPE
    return torch.cat(images), torch.tensor(labels)


def _views(name: str, seed: int, rng: np.random.Generator) -> Tensor:
    """VIEWS_PER_SHAPE pictures of one shape with one set of materials."""
    mesh = primitives.build(name, seed)
    scale = LENGTH_MM / np.ptp(mesh.vertices, axis=0).max()
    mesh = dressed(dataclasses.replace(mesh, vertices=mesh.vertices * scale), rng)
    behind = Backgrounds(tuple(patterns.background(rng) for _ in range(VIEWS_PER_SHAPE)))
    stage = set_stage(bare_scene(_settings(rng), mesh, behind))
    conditions = stage.scene.draw("evaluate", VIEWS_PER_SHAPE, int(rng.integers(1 << 30)))
    half = VIEWS_PER_SHAPE // 2
    small = photograph(stage, None, conditions[:half], (INPUT_PX, INPUT_PX))
    large = photograph(stage, None, conditions[half:], (PHOTO_PX, PHOTO_PX))
    return codes_of(torch.cat([small, center_square(large, INPUT_PX)]))


def _settings(rng: np.random.Generator) -> SceneSettings:
    """Ranges for one shape: the object fills a quarter to nine tenths of the picture, seen from all round."""
    fov_deg = rng.uniform(25, 65)
    share = np.exp(rng.uniform(np.log(0.3), np.log(0.85)))
    distance = LENGTH_MM / (2 * np.tan(np.radians(fov_deg) / 2) * share)
    nearest = max(0.85 * distance, 1.05 * LENGTH_MM)  # nearer than that, the camera could be in the object
    return validated(
        SceneSettings,
        {
            "object": {"mesh": "primitive:mug", "length_mm": LENGTH_MM},
            "patch": {"width_mm": 10, "height_mm": 10, "side": str(rng.choice(["+x", "-x", "+z", "-z"]))},
            "target": {"label": 0, "models": ["builtin"]},
            "view": {
                "azimuth_deg": [-180, 180],
                "elevation_deg": [-10, 60],
                "roll_deg": [-10, 10],
                "distance_mm": [nearest, max(1.2 * distance, nearest)],
                "fov_deg": fov_deg,
                "look_at_jitter": 0.1,
            },
            "light": {"ambient": [0.2, 0.8], "directional": [0.1, 0.9]},
            "camera": {
                "photo_px": [PHOTO_PX, PHOTO_PX],
                "exposure_ev": [-0.8, 0.6],
                "white_balance": 0.15,
                "blur_px": [0, 1.5],
                "noise": [0, 0.04],
                "jpeg": [40, 95],
            },
        },
        "the training recipe",
    )


def dressed(mesh: Mesh, rng: np.random.Generator) -> Mesh:
    """The mesh with its own colors (half of the time), with worn ones, or with drawn colors and textures."""
    kind = rng.choice(["own", "worn", "mixed", "drawn"], p=[0.5, 0.2, 0.2, 0.1])
    materials = []
    for material in mesh.materials:
        if kind == "worn":
            worn = np.clip(0.8 + 0.25 * (patterns.texture(rng).mean(2, keepdims=True) - 0.5), 0, 1).repeat(3, 2)
            material = dataclasses.replace(material, texture_srgb=codes_of(worn))
        if kind == "drawn" or (kind == "mixed" and rng.random() < 0.4):
            plain = rng.random() < 0.4
            color = tuple(rng.uniform(0.02, 0.9, 3)) if plain else (1.0, 1.0, 1.0)
            drawn = None if plain else codes_of(patterns.texture(rng))
            material = dataclasses.replace(material, base_color_linear=color, texture_srgb=drawn)
        materials.append(material)
    return dataclasses.replace(mesh, materials=tuple(materials))


if __name__ == "__main__":
    main()
