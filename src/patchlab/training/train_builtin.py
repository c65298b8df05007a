"""How the built-in network was made: `python -m patchlab.training.train_builtin --out DIR`.

In: nothing but seeds (pictures.py); a small convolutional network learns to name the objects. Out:
`builtin.safetensors` and `builtin.json` with the recipe, its seeds and the accuracy on shapes, textures and backgrounds
that training never saw.

Another architecture learns from the same pictures where `--network` names what makes it, which is called with
`num_classes` and what `--settings` says: `--name levit --network timm.create_model --settings '{"model_name":
"levit_128s", "img_size": 96}'`. It is loaded as `file:DIR/levit.onnx`, without the library that it is from; writing it
takes `pip install "patchproof[lab]"`.
"""

from __future__ import annotations

import json
import pkgutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.training import fit
from patchlab.training.card import export_onnx, round_by_class, store_float16, write_card
from patchlab.training.pictures import Pictures, augment, shrink_pictures
from patchproof.classifier.builtin import DEVIATION, INPUT_PX, MEAN, SmallNetwork
from patchproof.classifier.zoo import Normalized
from patchproof.mesh import primitives


@dataclass(frozen=True)
class ClassifierRecipe(fit.TrainingRecipe):
    """The built-in network's, or another's."""

    label_smoothing: float = 0.1  # keeps the softmax off its ends, where gradients vanish
    name: str = "builtin"  # of the files
    network: str = ""  # package.module.callable of another architecture
    settings: str = "{}"  # what it is called with, in JSON
    input_px: int = INPUT_PX  # what another one takes of the pictures' 96


def train(shown: Pictures, recipe: ClassifierRecipe) -> fit.Epochs:
    """After each epoch: its number, its mean loss, and the network as it is."""
    loss_of = torch.nn.CrossEntropyLoss(label_smoothing=recipe.label_smoothing)

    def learn(network: torch.nn.Module, rows: Tensor, cards: Tensor, rng: np.random.Generator) -> Tensor:
        batch, _ = augment(shown.images[rows], shown.boxes[rows], cards, rng, recipe.pasted)
        return loss_of(network(batch.contiguous(memory_format=torch.channels_last)), shown.labels[rows])

    return fit.train_epochs(lambda: build_network(recipe), shown, recipe, learn)


def build_network(recipe: ClassifierRecipe) -> torch.nn.Module:
    """The recipe's network: N×3×S×S sRGB in [0, 1] → N×K logits."""
    classes = len(primitives.primitive_names())
    if not recipe.network:
        return SmallNetwork(classes, batch_norm=True)
    made = pkgutil.resolve_name(recipe.network)(num_classes=classes, **json.loads(recipe.settings))
    return Normalized(made, [MEAN] * 3, [DEVIATION] * 3)


def write(
    out: Path, trained: torch.nn.Module, recipe: ClassifierRecipe, held_out: Pictures, seconds: fit.Seconds
) -> None:
    """The network and what is known about it; the accuracy is that of what is stored."""
    if recipe.network:
        network, count = trained, export_onnx(trained, out / f"{recipe.name}.onnx", recipe.input_px)
    else:
        network = fit.fold_batch_norm(trained)
        count = store_float16(network, out / f"{recipe.name}.safetensors")
    right = accuracy_by_class(network, held_out)
    figures = {
        "input_px": recipe.input_px,
        "weights": count,
        "held_out_accuracy": round(float(right.mean()), 4),
        "held_out_accuracy_by_class": round_by_class(right),
    }
    write_card(out / f"{recipe.name}.json", figures, "train_builtin", recipe, seconds)
    print(f"held-out accuracy {figures['held_out_accuracy']:.3f}: {figures['held_out_accuracy_by_class']}")


@torch.no_grad()
def accuracy_by_class(network: torch.nn.Module, shown: Pictures) -> np.ndarray:
    """Share of right answers, class by class."""
    was_training = network.training
    network.eval()
    right = torch.cat([network(batch.float() / 255).argmax(1) for batch in shown.images.split(256)]) == shown.labels
    network.train(was_training)
    return np.array(
        [right[shown.labels == label].float().mean().item() for label in range(int(shown.labels.max()) + 1)]
    )


def main() -> None:
    """Render, train, measure, and write the network with its card."""
    about = "Train a network to name objects in procedural renders."
    fit.run(
        ClassifierRecipe,
        about,
        INPUT_PX,
        train,
        accuracy_by_class,
        write,
        lambda shown, recipe: shrink_pictures(shown, recipe.input_px),
    )


if __name__ == "__main__":
    main()
