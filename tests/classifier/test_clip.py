"""Networks of pictures and text, with weights from a file: nothing is downloaded."""

from __future__ import annotations

import json

import pytest
import torch
from safetensors.torch import save_file
from small_networks import seeded

from patchproof.base.errors import Refused
from patchproof.classifier import load_classifier
from test_zoo import judged

pytestmark = pytest.mark.filterwarnings("ignore:the network")  # doubts: weights are noise

PROMPTS = [f"a photo of a {name}" for name in ("mug", "box truck", "carton", "chair")]
TINY = {
    "embed_dim": 24,
    "vision_cfg": {"image_size": 32, "layers": 2, "width": 48, "head_width": 24, "patch_size": 8},
    "text_cfg": {"context_length": 16, "vocab_size": 49408, "width": 32, "heads": 2, "layers": 1},
}


@pytest.fixture
def tiny(torchvision, tmp_path):
    """open_clip's own form of the network whose weights and prompts lie in `tmp_path`."""
    open_clip = pytest.importorskip("open_clip", reason='needs open_clip, of the extra "clip"')
    (tmp_path / "tiny.json").write_text(json.dumps(TINY))
    open_clip.add_model_config(tmp_path / "tiny.json")
    network = seeded(open_clip.create_model("tiny"))
    save_file(network.state_dict(), tmp_path / "w.safetensors")
    write_card(tmp_path)
    return network


def write_card(folder, **card) -> None:
    (folder / "w.json").write_text(json.dumps({"input_px": 32, "labels": PROMPTS} | card))


def test_logits_are_those_of_the_librarys_own_two_halves(tiny, tmp_path):
    import open_clip

    classifier = load_classifier("clip:tiny@w.safetensors", tmp_path)
    assert (classifier.name, list(classifier.labels)) == ("clip:tiny@w.safetensors", PROMPTS)
    photos = torch.rand(3, 3, 32, 32)
    mean, std = (torch.tensor(value)[:, None, None] for value in (tiny.visual.image_mean, tiny.visual.image_std))
    with torch.no_grad():
        theirs, _ = tiny.get_logits((photos - mean) / std, open_clip.get_tokenizer("tiny")(PROMPTS))
    torch.testing.assert_close(classifier.logits(photos), theirs, rtol=1e-4, atol=1e-4)
    assert not any("text" in key or "token" in key for key in classifier.network.state_dict())


def test_other_prompts_are_another_network(tiny, tmp_path):
    before = load_classifier("clip:tiny@w.safetensors", tmp_path).sha256
    write_card(tmp_path, labels=PROMPTS[::-1])
    assert load_classifier("clip:tiny@w.safetensors", tmp_path).sha256 != before


def test_it_goes_from_a_scene_to_a_verdict(tiny, tmp_path):
    run, _ = judged(tmp_path, "clip:tiny@w.safetensors", PROMPTS[2])
    assert run.promise.target.indices == (2,)


def test_what_does_not_fit_is_refused(tiny, tmp_path):
    for name, sentence in {
        "tiny": "prompts, as clip:MODEL@WEIGHTS",
        "tiny@w.pt": "prompts, as clip:MODEL@WEIGHTS",
        "tinny@w.safetensors": r'a model of open_clip, got "tinny".*"tiny"',
        "tiny@v.safetensors": r"a JSON file, got no file at .*v\.json",
        "ViT-B-32@w.safetensors": r"weights of clip:ViT-B-32, got .*w\.safetensors, where",
    }.items():
        with pytest.raises(Refused, match=sentence):
            load_classifier(f"clip:{name}", tmp_path)
    write_card(tmp_path, input_px=64)
    with pytest.raises(Refused, match=r'the input size of clip:tiny, got 64 in .*w\.json: write "input_px": 32'):
        load_classifier("clip:tiny@w.safetensors", tmp_path)


def test_the_library_that_is_missing_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(__import__("sys").modules, "open_clip", None)
    with pytest.raises(Refused, match=r"the library open_clip for clip:NAME"):
        load_classifier("clip:tiny@w.safetensors", tmp_path)
