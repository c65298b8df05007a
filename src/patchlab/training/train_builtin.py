"""Train the built-in classifier: `python -m patchlab.training.train_builtin --out DIR`.

In: seeds (`training.pictures`); a small convolutional network learns to name the objects. Out: `builtin.safetensors`
and `builtin.json` with the recipe, its seeds and the accuracy on shapes, textures and backgrounds that training never
saw.

`--network` names a callable that makes another architecture for these pictures; it is called with `num_classes` and
the arguments in `--settings`: `--name levit --network timm.create_model --settings '{"model_name":
"levit_128s", "img_size": 96}'`. `file:DIR/levit.onnx` loads it without the library it comes from; writing it
takes `pip install "patchproof[lab]"`.
"""

import json
import pkgutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from patchlab.training import fit
from patchlab.training.fit import export_onnx, round_by_class, store_float16, write_card
from patchlab.training.pictures import Pictures, augment, shrink_pictures
from patchproof.classifier.builtin import DEVIATION, INPUT_PX, MEAN, SmallNetwork
from patchproof.classifier.zoo import Normalized
from patchproof.mesh import primitives


@dataclass(frozen=True)
class ClassifierRecipe(fit.TrainingRecipe):
    """The recipe of the built-in classifier, or of another architecture."""

    label_smoothing: float = 0.1  # keeps the softmax off its ends, where gradients vanish
    name: str = "builtin"  # name of the files
    network: str = ""  # package.module.callable of another architecture
    settings: str = "{}"  # its keyword arguments as JSON
    input_px: int = INPUT_PX  # input size of another architecture; pictures are rendered at 96


def train(pictures: Pictures, recipe: ClassifierRecipe) -> fit.Epochs:
    """Train the classifier; yields (number, mean loss, network) after each epoch."""
    loss_of = torch.nn.CrossEntropyLoss(label_smoothing=recipe.label_smoothing)

    def learn(network: torch.nn.Module, rows: Tensor, cards: Tensor, rng: np.random.Generator) -> Tensor:
        batch, _ = augment(pictures.images[rows], pictures.boxes[rows], cards, rng, recipe.pasted)
        return loss_of(network(batch.contiguous(memory_format=torch.channels_last)), pictures.labels[rows])

    return fit.train_epochs(lambda: build_network(recipe), pictures, recipe, learn)


def build_network(recipe: ClassifierRecipe) -> torch.nn.Module:
    """Build the recipe's untrained network: N×3×S×S sRGB in [0, 1] → N×K logits."""
    classes = len(primitives.primitive_names())
    if not recipe.network:
        return SmallNetwork(classes, batch_norm=True)
    module = pkgutil.resolve_name(recipe.network)(num_classes=classes, **json.loads(recipe.settings))
    return Normalized(module, [MEAN] * 3, [DEVIATION] * 3)


def write(
    out: Path, trained: torch.nn.Module, recipe: ClassifierRecipe, held_out: Pictures, seconds: fit.Seconds
) -> None:
    """Write the network and its card; the accuracy is that of the stored network."""
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
def accuracy_by_class(network: torch.nn.Module, pictures: Pictures) -> np.ndarray:
    """Share of correct answers by class."""
    was_training = network.training
    network.eval()
    answers = torch.cat([network(batch.float() / 255).argmax(1) for batch in pictures.images.split(256)])
    network.train(was_training)
    right, labels = answers == pictures.labels, range(int(pictures.labels.max()) + 1)
    return np.array([right[pictures.labels == label].float().mean().item() for label in labels])


def main() -> None:
    """Render, train, measure, and write the network with its card."""
    about = "Train a network to name objects in procedural renders."
    prepare = lambda pictures, recipe: shrink_pictures(pictures, recipe.input_px)  # noqa: E731
    fit.run(ClassifierRecipe, about, INPUT_PX, train, accuracy_by_class, write, prepare)


if __name__ == "__main__":
    main()
