"""Names, self-checks, and the three ways to a network other than a file."""

import sys
import types
import warnings
from dataclasses import replace

import pytest
import torch
from torch import nn

from patchlab.training.fit import fold_batch_norm
from patchproof.base.errors import Refused
from patchproof.classifier import Classifier, load, load_classifier, zoo
from patchproof.classifier.builtin import SmallNetwork
from patchproof.classifier.check import check_network
from patchproof.classifier.custom import classifier_of
from patchproof.classifier.load import use_full_precision
from patchproof.classifier.network import weights_sha256

LABELS = ("a", "b", "c", "d")


class Good(nn.Module):
    """A network that passes: four weighted means of colors in four quarters."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.randn(4, 12, generator=torch.Generator().manual_seed(0)) * 5)

    def forward(self, x):
        return nn.functional.adaptive_avg_pool2d(x, 2).flatten(1) @ self.weight.T


GOOD = Good().eval()


def check(network, labels=LABELS) -> None:
    check_network(Classifier("it", None, 16, labels, network))


def test_a_good_network_passes_without_a_word():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check(GOOD)


FAULTS = {
    "Expected 4 logits for each picture.*\\(3, 3\\) for 3 pictures from the network it": lambda x: GOOD(x)[:, :3],
    "list for 3 pictures from": lambda x: list(GOOD(x)),
    "probabilities from the network it.*leave its last Softmax or Sigmoid out": lambda x: GOOD(x).softmax(1),
    "the same logits for the same pictures": lambda x: GOOD(x) + torch.rand(4),
    "do not depend on the rest of the batch": lambda x: GOOD(x - x.mean(0)) if len(x) > 1 else GOOD(x),
    "tells pictures apart": lambda x: GOOD(x * 0 + 0.5) + 1e-9 * GOOD(x),
    "a gradient from the logits to the pixels, got none from the network it": lambda x: GOOD(x.detach()),
    "a zero or infinite one from": lambda x: GOOD((x * 255).round() / 255),
    "Expected finite logits": lambda x: GOOD(x).log(),
    "which fails on 3×3×16×16": lambda x: GOOD(x[:, :2]),
}


@pytest.mark.parametrize("sentence", FAULTS)
def test_each_fault_is_refused_by_its_name(sentence):
    with pytest.raises(Refused, match=sentence):
        check(FAULTS[sentence])


def test_dropout_and_batch_statistics_left_in_training_mode_are_found():
    noisy = nn.Sequential(nn.Flatten(), nn.Linear(768, 8), nn.Dropout(0.5), nn.Linear(8, 4))
    crowded = nn.Sequential(
        nn.Flatten(), nn.Linear(768, 8), nn.BatchNorm1d(8, track_running_stats=False), nn.Linear(8, 4)
    )
    for network, sentence in ((noisy, "same logits for the same"), (crowded, "rest of the batch|fails on")):
        with pytest.raises(Refused, match=sentence):
            check(network.train())
        if network is noisy:
            check(network.eval())


def test_doubts_are_warned_about_and_let_pass():
    with pytest.warns(UserWarning, match="the network it .*may not see color"):
        check(lambda x: GOOD(x.mean(1, keepdim=True).expand(-1, 3, -1, -1)))
    with pytest.warns(UserWarning, match="hardly tells pictures apart"):
        check(lambda x: GOOD(0.5 + x / 1e5))
    with pytest.warns(UserWarning, match="is certain of pictures that show nothing"):
        check(lambda x: GOOD(x) * 1e3)


def test_what_is_odd_about_a_network_stays_with_it():
    classifier = Classifier("it", None, 16, LABELS, lambda x: GOOD(0.5 + x / 1e5))
    with pytest.warns(UserWarning, match="hardly tells pictures apart"):
        (note,) = load_classifier(classifier).notes
    assert "hardly tells pictures apart" in note


def test_a_network_is_checked_once_as_long_as_nothing_about_it_changes(monkeypatch):
    checked, taken = load_classifier(Classifier("it", None, 16, LABELS, GOOD)), []
    monkeypatch.setattr(load, "check_network", lambda *given: taken.append(given))
    assert load_classifier(checked) is checked and not taken
    again = load_classifier(replace(checked, labels=LABELS[:-1]))
    assert len(taken) == 1 and again.labels == LABELS[:-1] and load_classifier(again) is again
    load_classifier(checked)  # the network is the same, the labels are not
    assert len(taken) == 2


@pytest.mark.parametrize("name", ["resnet50", "", "torch:x", "models/a.onnx", "http://x/y.pt2", "Builtin"])
def test_a_name_of_no_known_form_is_refused(name, tmp_path):
    with pytest.raises(Refused, match=r'file:NAME\.onnx or module:package\.factory, got "' + name):
        load_classifier(name, tmp_path)


def test_a_variable_that_is_not_set_and_a_file_that_is_not_there(tmp_path, monkeypatch):
    monkeypatch.delenv("NOWHERE", raising=False)
    with pytest.raises(Refused, match="environment variable NOWHERE"):
        load_classifier("file:${NOWHERE}/a.onnx", tmp_path)
    with pytest.raises(Refused, match=r"no file at .*a\.onnx"):
        load_classifier("file:a.onnx", tmp_path)


# ------------------------------------------------------------------------------------------------ torchvision, timm


def test_missing_or_broken_libraries_are_named_with_the_command(tmp_path, monkeypatch):
    for name in ("torchvision", "timm"):
        monkeypatch.setitem(sys.modules, name, None)  # what import does where it is not installed
        with pytest.raises(Refused, match=rf'the library {name} .*pip install "patchproof\[models\]".*CPU index'):
            load_classifier(f"{name}:resnet50", tmp_path)

    def built_for_another_torch(name):
        raise RuntimeError("operator torchvision::nms does not exist")

    monkeypatch.setattr(zoo.importlib, "import_module", built_for_another_torch)
    with pytest.raises(Refused, match=r"nms does not exist\): remove torchvision and .* from where torch is from"):
        load_classifier("torchvision:resnet50", tmp_path)


def test_weights_without_bytes_of_their_own_have_no_sum():
    sparse = torch.nn.Linear(2, 2)
    sparse.register_buffer("eye", torch.eye(2).to_sparse())
    assert weights_sha256(sparse) is None and weights_sha256(torch.nn.Linear(2, 2)) is not None


def test_weights_of_inference_mode_are_refused_by_name(tmp_path):
    with torch.inference_mode():
        network = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 8), torch.nn.Flatten())
    with pytest.raises(Refused, match=r"whose gradient fails \(RuntimeError: Inference tensors"):
        load_classifier(classifier_of(network, 8, ["a", "b", "c", "d"]), tmp_path)


def fake_torchvision(monkeypatch, network, broken=False) -> None:
    seen = types.SimpleNamespace(crop_size=[16], mean=[0.4, 0.5, 0.6], std=[0.2, 0.3, 0.4])
    weights = types.SimpleNamespace(transforms=lambda: seen, meta={"categories": list(LABELS)})

    def get_model(name, weights):
        if broken:
            raise OSError("no route to host\nand more")
        return network

    models = types.SimpleNamespace(
        detection=None,
        list_models=lambda module: ["resnet18", "resnet50"] if module else [],
        get_model_weights=lambda name: types.SimpleNamespace(DEFAULT=weights),
        get_model=get_model,
    )
    monkeypatch.setitem(sys.modules, "torchvision", types.SimpleNamespace(models=models))


def test_torchvision_is_wrapped_with_its_own_figures(tmp_path, monkeypatch):
    network = Good().train()
    fake_torchvision(monkeypatch, network)
    classifier = load_classifier("torchvision:resnet50", tmp_path)
    assert (classifier.name, classifier.input_px, classifier.labels) == ("torchvision:resnet50", 16, LABELS)
    photos = torch.rand(2, 3, 16, 16)
    by_hand = (photos - torch.tensor([0.4, 0.5, 0.6])[:, None, None]) / torch.tensor([0.2, 0.3, 0.4])[:, None, None]
    torch.testing.assert_close(classifier.logits(photos), network(by_hand))
    assert not network.training and not any(parameter.requires_grad for parameter in network.parameters())
    assert classifier.sha256 == weights_sha256(classifier.network.network)
    with pytest.raises(Refused, match='"resnet5": did you mean "resnet50"'):
        load_classifier("torchvision:resnet5", tmp_path)
    fake_torchvision(monkeypatch, network, broken=True)
    with pytest.raises(Refused, match=r"published weights of torchvision:resnet50, got OSError \(no route to host\)"):
        load_classifier("torchvision:resnet50", tmp_path)


def test_timm_is_wrapped_with_its_own_figures(tmp_path, monkeypatch):
    network = Good()
    network.num_classes, network.pretrained_cfg = 4, {}
    subset = "imagenet-1k"

    class Info:
        def __init__(self, subset):
            assert subset == "imagenet-1k"

        def index_to_description(self, index):
            return LABELS[index]

    data = types.SimpleNamespace(
        infer_imagenet_subset=lambda model: subset,
        ImageNetInfo=Info,
        resolve_model_data_config=lambda m: {"mean": (0.5,) * 3, "std": (0.25,) * 3, "input_size": (3, 16, 16)},
    )
    fake = types.SimpleNamespace(
        data=data,
        is_model=lambda name: name == "vit",
        list_models=lambda: ["vit"],
        create_model=lambda name, pretrained: offline.append(hub.HF_HUB_OFFLINE) or network,
    )
    monkeypatch.setitem(sys.modules, "timm", fake)
    hub = types.SimpleNamespace(ENDPOINT="https://localhost:9", HF_HUB_OFFLINE=False)  # nobody listens there
    monkeypatch.setitem(sys.modules, "huggingface_hub.constants", hub)
    monkeypatch.setattr(zoo, "getproxies", dict)
    offline = []
    classifier = load_classifier("timm:vit", tmp_path)
    photos = torch.rand(2, 3, 16, 16)
    torch.testing.assert_close(classifier.logits(photos), network(photos * 4 - 2))
    assert offline == [True] and not hub.HF_HUB_OFFLINE  # no second try where there is no way to the hub
    with pytest.raises(Refused, match=r'"zzz": choose one of timm\.list_models'):
        load_classifier("timm:zzz", tmp_path)
    subset = None
    with pytest.raises(Refused, match="labels are known"):
        load_classifier("timm:vit", tmp_path)
    network.pretrained_cfg = {"label_names": list("wxyz"), "label_descriptions": {"x": "a sheep"}}
    assert load_classifier("timm:hf-hub:org/vit@main", tmp_path).labels == ("w", "a sheep", "y", "z")
    with pytest.raises(Refused, match="choose one of timm"):
        load_classifier("timm:hf-hub/vit", tmp_path)


# ------------------------------------------------------------------------------------------------ the user's own code

OWN = """
import torch
from patchproof.classifier import Classifier

class Net(torch.nn.Module):
    input_px, labels = 16, ["up", "down"]
    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor([[1.0, 2.0, 4.0], [-3.0, 1.0, 0.0]]))
    def forward(self, x):
        return x.mean((2, 3)) @ self.weight.T

def as_classifier():
    return Classifier("mine", None, 16, ("up", "down"), Net())

def nothing():
    return object()

def fails():
    raise OSError("no weights here")
"""


def test_own_code_beside_the_scene_gives_a_network_or_a_classifier(tmp_path):
    (tmp_path / "own_networks_a.py").write_text(OWN)
    before = list(sys.path)
    network = load_classifier("module:own_networks_a.Net", tmp_path)
    classifier = load_classifier("module:own_networks_a.as_classifier", tmp_path)
    assert sys.path == before
    assert network.labels == classifier.labels == ("up", "down") and network.input_px == 16
    assert network.name == "module:own_networks_a.Net" and len(network.sha256) == 64
    photos = torch.rand(2, 3, 16, 16)
    torch.testing.assert_close(network.logits(photos), classifier.logits(photos))


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("own_networks_b.nothing", "an object of type object: give it input_px"),
        ("own_networks_b.fails", r"OSError \(no weights here\): fix the factory"),
        ("own_networks_b.absent", "a function absent in own_networks_b, got none"),
        ("not_there.factory", "an import that fails.*put it beside the scene file"),
        ("own_broken.factory", r"own_broken.*an import that fails \(name 'j' is not defined\): correct its code"),
        ("own_networks_b", "name a module and a function in it"),
        ("os.path;x.y", "name a module and a function in it"),
    ],
)
def test_own_code_that_is_not_as_said_is_refused(name, sentence, tmp_path, monkeypatch):
    (tmp_path / "own_networks_b.py").write_text(OWN)
    (tmp_path / "own_broken.py").write_text("j")
    monkeypatch.delitem(sys.modules, "own_networks_b", raising=False)
    with pytest.raises(Refused, match=sentence):
        load_classifier(f"module:{name}", tmp_path)


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ({"labels": {"dog": 1, "cat": 0}}, r"got {'dog': 1, 'cat': 0} in python:network: list them in the order of"),
        ({"labels": {"dog", "cat"}}, "labels, a list of 2 or more names, got {"),
        ({"labels": {"dog": 1, "cat": 0}.keys()}, r"got dict_keys\(\['dog', 'cat'\]\)"),
        ({"labels": ["dog"]}, r"a list of 2 or more names, got \['dog'\]"),
        ({"labels": [], "kind": "detector"}, r"a list of 1 or more names, got \[\]"),
        ({"labels": {0: "dog"}, "kind": "detector"}, "a list of 1 or more names, got {0: 'dog'}"),
        ({"input_px": 0}, "input_px, a whole number from 8 to 4096, got 0 in python:network"),
        ({"input_px": 100_000}, "from 8 to 4096, got 100000"),
        ({"input_px": True}, "from 8 to 4096, got True"),
    ],
)
def test_a_network_in_memory_says_its_size_and_its_labels_in_order(said, sentence):
    module = torch.nn.Sequential(torch.nn.Flatten())
    for name, value in {"input_px": 16, "labels": LABELS, **said}.items():
        setattr(module, name, value)
    with pytest.raises(Refused, match=sentence):
        load_classifier(module)


# ------------------------------------------------------------------------------------------------ the built-in network


def test_folding_the_batch_norms_changes_nothing_but_the_speed():
    torch.manual_seed(0)
    trained = SmallNetwork(5, batch_norm=True)
    trained.train()(torch.rand(8, 3, 96, 96))  # statistics that are not 0 and 1
    for norm in (module for module in trained.modules() if isinstance(module, nn.BatchNorm2d)):
        nn.init.uniform_(norm.weight, 0.5, 2)
        nn.init.normal_(norm.bias)
    photos = torch.rand(4, 3, 96, 96)
    plain = fold_batch_norm(trained.eval())
    assert not any(isinstance(module, nn.BatchNorm2d) for module in plain.modules())
    with torch.no_grad():
        torch.testing.assert_close(plain(photos), trained(photos), rtol=1e-4, atol=1e-4)
    assert sum(parameter.numel() for parameter in plain.parameters()) <= 700_000


def test_a_gpu_convolves_in_full_precision(monkeypatch):
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", True)
    use_full_precision("cpu")
    assert torch.backends.cudnn.allow_tf32
    use_full_precision("cuda:1")
    assert not torch.backends.cudnn.allow_tf32
