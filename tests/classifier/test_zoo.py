"""torchvision's and timm's own networks, with weights from a file: nothing is downloaded."""

from __future__ import annotations

import hashlib
import json
import warnings
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from conftest import SCENE
from safetensors.torch import save_file
from small_networks import seeded

import patchproof as pp
from patchlab.validation.path_traced import photograph_traced
from patchproof.app.begin.new import _model
from patchproof.base.errors import Refused
from patchproof.classifier import load_classifier, zoo
from patchproof.reprints.reprint import ReprintSetup

pytestmark = pytest.mark.filterwarnings("ignore:the network")  # doubts: weights are noise

LABELS = [f"label {number}" for number in range(12)]


def saved(path, network, labels=LABELS, input_px=None) -> None:
    """Weights, and a card where the labels are not the published ones."""
    save_file(seeded(network).state_dict(), path)
    if input_px is not None:
        path.with_suffix(".json").write_text(json.dumps({"input_px": input_px, "labels": labels}))


def normalized(photos, mean, std):
    return (photos - torch.tensor(mean)[:, None, None]) / torch.tensor(std)[:, None, None]


def judged(folder, model, label) -> tuple[pp.Run, pp.Report]:
    """The run and report of a small journey from a scene before a network to the verdict on three photographs."""
    text = SCENE.replace('"builtin"', f'"{model}"').replace('label = "carton"', f'label = "{label}"')
    (folder / "scene.toml").write_text(text.replace("steps = 3\nviews = 4", "steps = 2\nviews = 2"), encoding="utf-8")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
        run = pp.optimize(pp.load_scene(folder / "scene.toml"), folder / "run", promise=pp.PromiseOptions(8))
    assert np.ptp(run.design) > 0  # gradients came through all of it
    pp.sheet(run, folder / "sheet.pdf")
    # by a renderer that is not ours where it is installed
    how = ReprintSetup(render=photograph_traced) if find_spec("mitsuba") else ReprintSetup()
    pp.reprint(folder / "sheet.pdf", run, 3, folder / "photos", how)
    report = pp.verify(folder / "photos", folder / "sheet.json", folder / "report", trust=True, ledger_photos=0)
    assert report.summary.photos == 3 and report.summary.verdict in ("kept", "broken", "cannot_tell")
    print(f"{model}: {report.summary.measured} of 3 measured, {report.summary.verdict}")
    return run, report


IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@pytest.mark.parametrize(("name", "px"), [("resnet18", 64), ("densenet121", 64), ("shufflenet_v2_x0_5", 64)])
def test_torchvisions_families_from_a_file_with_own_labels(name, px, torchvision, tmp_path):
    network = torchvision.models.get_model(name, num_classes=12)
    saved(tmp_path / "w.safetensors", network, input_px=px)
    classifier = load_classifier(f"torchvision:{name}@w.safetensors", tmp_path)
    assert (classifier.name, list(classifier.labels)) == (f"torchvision:{name}@w.safetensors", LABELS)
    photos = torch.rand(2, 3, px, px)
    torch.testing.assert_close(classifier.logits(photos), network(normalized(photos, *IMAGENET)), rtol=1e-4, atol=1e-4)


def test_googlenets_published_form_has_heads_for_training_and_another_normalization(torchvision, tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        network = torchvision.models.googlenet(init_weights=False, transform_input=True)
    saved(tmp_path / "w.safetensors", network)
    without = {key: tensor for key, tensor in network.state_dict().items() if not key.startswith("aux")}
    save_file(without, tmp_path / "v.safetensors")
    photos, answers = torch.rand(2, 3, 224, 224), []
    for file in ("w", "v"):
        classifier = load_classifier(f"torchvision:googlenet@{file}.safetensors", tmp_path)
        assert classifier.input_px == 224 and classifier.labels[967] == "espresso"
        answers.append(classifier.logits(photos))
    torch.testing.assert_close(answers[0], network(normalized(photos, *IMAGENET)), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(*answers)


@pytest.mark.parametrize("name", ["vit_tiny_patch16_224", "convnext_atto"])
def test_timms_families_from_a_file(name, tmp_path):
    timm = pytest.importorskip("timm", reason='needs timm, of the extra "models"')
    network = timm.create_model(name)
    saved(tmp_path / "w.safetensors", network)
    classifier = load_classifier(f"timm:{name}@w.safetensors", tmp_path)
    view = timm.data.resolve_model_data_config(network)
    assert classifier.input_px == view["input_size"][-1] and "espresso" in classifier.labels[967]
    photos = torch.rand(1, 3, 224, 224)
    by_hand = network(normalized(photos, view["mean"], view["std"]))
    torch.testing.assert_close(classifier.logits(photos), by_hand, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "px"),
    [
        ("torchvision:resnet18", 64),
        ("torchvision:vgg11", 32),
        ("torchvision:densenet121", 64),
        ("torchvision:googlenet", 64),
        ("torchvision:shufflenet_v2_x0_5", 64),
        ("timm:convnext_atto", 64),
        ("timm:vit_tiny_patch16_224", 224),
    ],
)
def test_each_family_goes_from_a_scene_to_a_verdict(name, px, torchvision, tmp_path):
    library, _, model = name.partition(":")
    if library == "torchvision":
        options = {"init_weights": False} if model == "googlenet" else {}  # else seconds, and a warning
        network = torchvision.models.get_model(model, num_classes=len(LABELS), **options)
    else:
        network = pytest.importorskip("timm", reason='needs timm, of the extra "models"').create_model(
            model, num_classes=12
        )
    saved(tmp_path / "w.safetensors", network, input_px=px)
    run, _ = judged(tmp_path, f"{name}@w.safetensors", "label 3")
    assert run.promise.models[0].sha256 == hashlib.sha256((tmp_path / "w.safetensors").read_bytes()).hexdigest()


def test_weights_that_do_not_fit_are_refused(torchvision, tmp_path):
    saved(tmp_path / "w.safetensors", torchvision.models.shufflenet_v2_x0_5(num_classes=12))
    for name, sentence in {
        "shufflenet_v2_x0_5@w.safetensors": r"where fc\.bias is .*write the labels of a network with others into",
        "resnet18@w.safetensors": "weights of torchvision:resnet18 for 1000 labels",
        "resnet18@no.safetensors": r"no file at .*no\.safetensors",
        "resnet18@w.pth": r"weights in a file NAME\.safetensors, got w\.pth: save them with safetensors",
        "resnet18@b.safetensors": r"b\.safetensors that cannot be read",
    }.items():
        (tmp_path / "b.safetensors").write_bytes(b"\x80\4" + bytes(50))
        with pytest.raises(Refused, match=sentence):
            load_classifier(f"torchvision:{name}", tmp_path)


def test_a_new_scene_names_weights_from_its_own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for kind in ("file:", "torchvision:resnet18@", "timm:vit@"):
        assert _model(f"{kind}w.safetensors", tmp_path) == f"{kind}w.safetensors"
        assert _model(f"{kind}w.safetensors", tmp_path / "x") == f"{kind}{tmp_path}/w.safetensors"
    assert _model("timm:hf-hub:org/vit@main", tmp_path / "x") == "timm:hf-hub:org/vit@main"


def test_a_model_of_the_hub_needs_a_way_to_it(tmp_path, monkeypatch):
    pytest.importorskip("timm", reason='needs timm, of the extra "models"')

    def nowhere(*_, **__):
        raise OSError("no route")

    monkeypatch.setattr(zoo.socket, "create_connection", nowhere)
    monkeypatch.setattr(zoo, "getproxies", dict)
    monkeypatch.setenv("HF_HOME", str(tmp_path))
    with pytest.raises(Refused, match=r"published weights of timm:hf-hub:timm/none, got \w+ .*the internet connection"):
        load_classifier("timm:hf-hub:timm/none", tmp_path)
