"""The built-in network: what ships, and the recipe that made it."""

import dataclasses
import json

import numpy as np
import pytest
import torch

from patchlab.training import pictures as rendered
from patchlab.training import train_builtin
from patchlab.training.fit import Seconds, export_onnx
from patchlab.training.pictures import HELD_OUT_SEED, Pictures, augment, render_pictures, shrink_pictures
from patchproof.base.errors import Refused
from patchproof.classifier import find_labels, load_classifier
from patchproof.classifier.builtin import INPUT_PX, WEIGHTS_FOLDER, load_builtin
from patchproof.mesh import primitives

FRESH = 7_000_000  # renders that neither training nor its held-out set has seen


@pytest.fixture(scope="module")
def builtin():
    return load_classifier("builtin", WEIGHTS_FOLDER)  # warnings are errors: its self-checks have no doubts


@pytest.fixture(scope="module")
def fresh() -> Pictures:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rendered, "VIEWS_PER_SHAPE", 2)
        return render_pictures(2, FRESH, INPUT_PX)


def test_it_names_the_primitives_and_is_small(builtin):
    assert builtin.input_px == INPUT_PX == 96
    assert [find_labels(builtin.labels, name)[0] for name in primitives.primitive_names()] == list(range(12))
    assert (WEIGHTS_FOLDER / "builtin.safetensors").stat().st_size < 3_000_000
    assert not any(parameter.requires_grad for parameter in builtin.network.parameters())


def test_it_knows_fresh_renders_about_as_well_as_its_card_says(builtin, fresh):
    images, labels, _ = fresh
    card = json.loads((WEIGHTS_FOLDER / "builtin.json").read_text())
    assert card["held_out_accuracy"] >= 0.9
    with torch.no_grad():
        logits = builtin.logits(images.float() / 255)
    right = (logits.argmax(1) == labels).float().mean()
    # two views of one shape are alike, so this share scatters by about 0.05 on other seeds
    assert right > card["held_out_accuracy"] - 0.15
    # room left for gradients: label smoothing of 0.1 aims at 0.91
    assert np.median(builtin.confidence(logits, range(12)).numpy()) == pytest.approx(1)
    assert torch.softmax(logits, 1).amax(1).median() < 0.99


def test_missing_weights_are_refused(tmp_path):
    with pytest.raises(Refused, match="install patchproof again"):
        load_builtin(folder=tmp_path)


def test_pictures_are_repeatable_and_follow_the_seed(fresh, monkeypatch):
    images, labels, boxes = fresh
    assert images.dtype == torch.uint8 and images.shape == (24, 3, 96, 96)
    assert torch.equal(labels.bincount(), torch.full((12,), 2))
    assert boxes.shape == (24, 4) and bool((boxes[:, 2:] > boxes[:, :2]).all())
    assert (images.float().std((1, 2, 3)) > 1).all()  # none is blank
    names = primitives.primitive_names()[:3]
    monkeypatch.setattr(primitives, "primitive_names", lambda: names)
    monkeypatch.setattr(rendered, "VIEWS_PER_SHAPE", 1)
    first, again, other = (render_pictures(1, seed, INPUT_PX).images for seed in (3, 3, 4))
    assert len(first) == 3 and torch.equal(first, again)
    assert not any(torch.equal(one, another) for one, another in zip(first, other, strict=True))


def test_augmenting_keeps_the_range_and_pastes_as_often_as_said():
    images = torch.full((200, 3, 96, 96), 128, dtype=torch.uint8)
    cards = torch.ones(1, 3, 40, 40)

    def augment_at(pasted):
        return augment(images, torch.zeros(200, 4), cards, np.random.default_rng(0), pasted)[0]

    made = augment_at(0.3)
    assert torch.equal(made, augment_at(0.3))
    assert 0 <= made.min() and made.max() <= 1
    flat = made.std((2, 3)).amax(1) < 1e-6  # without a card a plain picture stays plain
    assert 0.6 < flat.float().mean() < 0.8
    assert (augment_at(0.0).std((2, 3)) < 1e-6).all()


def plain_colors() -> Pictures:
    """Twelve plain colors are twelve classes that can be learned at once."""
    colors = torch.randint(0, 256, (12, 3, 1, 1), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    labels = torch.arange(12).repeat(4)
    return Pictures(colors[labels].expand(-1, -1, 96, 96).contiguous(), labels, torch.zeros(len(labels), 4))


def test_training_is_repeatable_and_what_it_writes_can_be_loaded(tmp_path):
    recipe, shown = train_builtin.ClassifierRecipe(epochs=2, batch=12, pasted=0.0), plain_colors()
    before = torch.get_num_threads()
    runs = [list(train_builtin.train(shown, recipe)) for _ in range(2)]
    assert torch.get_num_threads() == before
    assert [loss for _, loss, _ in runs[0]] == [loss for _, loss, _ in runs[1]]
    train_builtin.write(tmp_path, runs[0][-1][2].eval(), recipe, shown, Seconds(1, 2))
    card = json.loads((tmp_path / "builtin.json").read_text())
    assert card["recipe"] == dataclasses.asdict(recipe)
    assert card["command"].endswith("train_builtin --out DIR --epochs 2 --batch 12 --pasted 0.0")
    loaded = load_builtin(folder=tmp_path)
    by_class = train_builtin.accuracy_by_class(loaded.network, shown)
    assert card["held_out_accuracy"] == pytest.approx(by_class.mean(), abs=1e-4)


@pytest.mark.filterwarnings("ignore::FutureWarning")  # torch's exporter warns of torch
def test_another_network_learns_by_the_same_command_from_pictures_that_are_kept(tmp_path, monkeypatch, capsys):
    pytest.importorskip("onnxscript", reason='torch\'s exporter needs onnxscript, of the extra "test"')
    rendered_seeds, shown = [], plain_colors()

    def fake_pictures(per_class, seed, size_px):
        rendered_seeds.append(seed)
        return shown

    monkeypatch.setattr(rendered, "render_pictures", fake_pictures)
    more = ("--pictures", str(tmp_path / "kept"), "--batch", "8", "--learning-rate", "0.1")
    network = ("--network", "fake_networks.MeanColor", "--settings", '{"steep": 2}', "--input-px", "32")
    for name, epochs in (("first", "1"), ("colors", "12")):
        # the first is of no use but for its pictures, and torch's exporter takes a second
        monkeypatch.setattr(train_builtin, "export_onnx", export_onnx if name == "colors" else lambda *_: 0)
        named = ["train_builtin", "--out", str(tmp_path), "--name", name, "--epochs", epochs]
        command = [*named, "--pasted", "0", *network, *more]
        monkeypatch.setattr("sys.argv", command)
        train_builtin.main()
    assert rendered_seeds == [HELD_OUT_SEED, 0]
    assert "epoch 12 of 12: loss " in capsys.readouterr().out
    classifier = load_classifier("file:colors.onnx", tmp_path)
    assert classifier.input_px == 32 and list(classifier.labels) == list(load_builtin().labels)
    card = json.loads((tmp_path / "colors.json").read_text())
    right = train_builtin.accuracy_by_class(classifier.network, shrink_pictures(shown, 32)).mean()
    assert right == pytest.approx(card["held_out_accuracy"], abs=1e-4) and right > 0.8
    assert "--network fake_networks.MeanColor --settings '{\"steep\": 2}'" in card["command"]


def test_reduced_pictures_are_means_of_what_they_cover():
    """Stripes a pixel wide are gray at half the size, and pictures of the size asked for stay as they are."""
    stripes = torch.zeros(1, 3, 8, 8, dtype=torch.uint8)
    stripes[..., ::2] = 200
    shown = Pictures(stripes, torch.zeros(1), torch.zeros(1, 4))
    assert torch.equal(shrink_pictures(shown, 8).images, stripes)
    half = shrink_pictures(shown, 4).images.int()
    assert half.shape == (1, 3, 4, 4) and (half[..., 1:-1] - 100).abs().max() <= 1


def test_held_out_shapes_are_none_of_the_training_shapes():
    recipe = train_builtin.ClassifierRecipe()
    shapes = recipe.pictures_per_class // rendered.VIEWS_PER_SHAPE
    assert recipe.seed + shapes < recipe.seed + HELD_OUT_SEED
    assert recipe.seed + HELD_OUT_SEED + recipe.held_out_per_class < FRESH
