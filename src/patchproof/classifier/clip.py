"""`clip:MODEL@FILE`: a network of pictures and text, whose labels are prompts.

In: a model that open_clip knows, with its weights in FILE.safetensors, or MODEL/PRETRAINED with the weights published
under that name and prompts in FILE.json; either way FILE.json is a network's card, whose labels are the prompts. Out: a
classifier like any other: a logit is the cosine between picture and prompt, times the network's own scale. The text
half of the network encodes the prompts once and is not kept.
Left out on purpose: means over several prompts of a label (write the one that counts), networks that write captions.

Source: Radford et al., Learning Transferable Visual Models From Natural Language Supervision, ICML 2021, section 3.1.
"""

from pathlib import Path

import torch
from torch import Tensor, nn

from patchproof.base.errors import Refused
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.labels import nearest_names
from patchproof.classifier.network import Classifier
from patchproof.classifier.network_file import read_card
from patchproof.classifier.zoo import Normalized, download, import_library, load_weights, read_weights


class Prompted(nn.Module):
    """The image half of a CLIP model, with K prompts as unit vectors K×E; `scale` multiplies the cosines."""

    def __init__(self, sees: nn.Module, prompts: Tensor, scale: Tensor):
        super().__init__()
        self.sees = sees
        self.prompts = nn.Buffer(prompts.detach().clone())
        self.scale = nn.Buffer(scale.detach().clone())

    def forward(self, photos: Tensor) -> Tensor:
        """N×3×S×S normalized pictures → N×K logits."""
        return self.scale * nn.functional.normalize(self.sees(photos), dim=-1) @ self.prompts.T


def load_clip(name: str) -> Classifier:
    """The classifier that `name`, MODEL@FILE, stands for."""
    open_clip = import_library("open_clip", "clip", "clip")
    model, _, file = name.rpartition("@")
    path, (architecture, _, published) = Path(file), model.partition("/")
    if not model or path.suffix not in (".safetensors", ".json"):
        expected = "prompts, as clip:MODEL@WEIGHTS.safetensors with WEIGHTS.json or clip:MODEL/PRETRAINED@PROMPTS.json"
        raise Refused(expected, f'"clip:{name}"', 'write {"input_px": 224, "labels": ["a photo of a mug", ...]} there')
    if architecture not in open_clip.list_models():
        do = nearest_names(architecture, open_clip.list_models(), "choose one of open_clip.list_models()")
        raise Refused("a model of open_clip", f'"{architecture}"', do)
    card = read_card(path.with_suffix(".json"))
    if path.suffix == ".json":
        options = {"pretrained": published or None, "require_pretrained": True}
        network = download(f"clip:{model}", lambda: open_clip.create_model(architecture, **options))
    else:
        network = open_clip.create_model(architecture)
        load_weights(network, read_weights(path), f"clip:{architecture}", "check the model's name")
    view, size = network.visual.preprocess_cfg, network.visual.image_size
    side_px = int(size if isinstance(size, int) else min(size))
    if side_px != card.input_px:
        do = f'write "input_px": {side_px} into it'
        raise Refused(f"the input size of clip:{architecture}", f"{card.input_px} in {path.with_suffix('.json')}", do)
    with torch.no_grad():
        prompts = network.eval().encode_text(open_clip.get_tokenizer(architecture)(list(card.labels)), normalize=True)
    sees = Prompted(network.visual, prompts, network.logit_scale.exp())
    return classifier_of(Normalized(sees, view["mean"], view["std"]), side_px, card.labels, f"clip:{name}")
