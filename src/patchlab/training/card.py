"""Store a trained network: weights as float16 or an ONNX file, and a card with its recipe and its accuracy."""

import dataclasses
import datetime
import json
import platform
import shlex
from pathlib import Path
from typing import Any

import torch
from torch import nn

from patchlab.training.fit import Seconds, TrainingRecipe
from patchproof.mesh import primitives

HELD_OUT_TEXT = "renders of other shapes, textures, backgrounds and conditions of the same kinds; nothing real"


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
    photos, any_number = torch.rand(2, 3, input_px, input_px), {0: torch.export.Dim("n")}
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
