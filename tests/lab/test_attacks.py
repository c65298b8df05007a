"""FGSM and PGD against another library's, and what makes an attack weak."""

from __future__ import annotations

import csv
import warnings

import pytest
import torch

from patchlab.harden.attacks import (
    balanced_loss,
    cross_entropy,
    fgsm,
    is_correct,
    lost_at,
    margin,
    pgd,
    pgd_outcomes,
    survives_fgsm,
)
from patchlab.harden.hardening import center_squares
from patchproof.classifier.builtin import load_builtin
from patchproof.classifier.load import load_classifier
from patchproof.photo.read import read_photo

pytestmark = pytest.mark.filterwarnings("ignore:.*resize_short_px")  # of the network's card: not used here


def foolbox():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # it names a module of SciPy by its old place
        return pytest.importorskip("foolbox")


@pytest.fixture(scope="module")
def real(data):
    """A real network, what it sees of the labeled photographs, and their labels."""
    classifier = load_classifier(f"file:{data}/models/mobilenet_v1_0.25_128.onnx", data)
    rows = list(csv.DictReader((data / "photos/labels.csv").read_text().splitlines()))
    pictures = center_squares([read_photo(data / "photos" / row["file"]).srgb for row in rows], classifier).clamp(0, 1)
    return classifier.network, pictures, torch.tensor([int(row["label"]) for row in rows])


class AsModule(torch.nn.Module):
    """The other library takes modules only."""

    def __init__(self, network):
        super().__init__()
        self.call = network

    def forward(self, pictures):
        return self.call(pictures)


def test_fgsm_is_the_other_librarys(real):
    library = foolbox()
    network, pictures, labels = real
    model = library.PyTorchModel(AsModule(network).eval(), bounds=(0, 1), device="cpu")
    theirs, _, _ = library.attacks.FGSM(random_start=False)(model, pictures, labels, epsilons=0.01)
    same = (fgsm(network, pictures, labels, 0.01, cross_entropy) - theirs).abs() < 1e-6
    assert same.double().mean() >= 0.9999


def test_pgd_leaves_the_other_librarys_accuracy_and_loss(real):
    library = foolbox()
    network, pictures, labels = real
    model = library.PyTorchModel(AsModule(network).eval(), bounds=(0, 1), device="cpu")
    for epsilon, steps in ((0.0005, 5), (0.01, 5)):
        attack = library.attacks.LinfPGD(rel_stepsize=0.25, steps=steps, random_start=False)
        # their run() takes no early leave: the raw pictures of the last step
        theirs = attack.run(model, pictures, library.criteria.Misclassification(labels), epsilon=epsilon)
        *_, ours = pgd(network, pictures, labels, epsilon, cross_entropy, steps)
        with torch.no_grad():
            theirs, ours = network(theirs), network(ours)
        assert is_correct(ours, labels).tolist() == is_correct(theirs, labels).tolist()
        ours, theirs = cross_entropy(ours, labels).mean(), cross_entropy(theirs, labels).mean()
        assert float((ours - theirs).abs()) < 1e-3


class Shouting(torch.nn.Module):
    """Two classes by the first pixel against ½, with logits that saturate float32's softmax."""

    def __init__(self, gain):
        super().__init__()
        self.gain = gain

    def forward(self, pictures):
        score = self.gain * (pictures[:, 0, 0, 0] - 0.5)
        return torch.stack([score, -score], 1)


def test_a_network_that_shouts_is_not_taken_for_a_robust_one():
    pictures, labels = torch.full((1, 3, 2, 2), 0.52), torch.zeros(1, dtype=torch.long)
    epsilon = 0.03  # enough to cross ½

    def float32(logits, labels):
        return torch.nn.functional.cross_entropy(logits.float(), labels, reduction="none")

    # margins 4, 400 and 800: float32 loses the gradient at 103, float64 at 745, the margin loss never
    for gain, holds32, holds64 in ((100, False, False), (10000, True, False), (20000, True, True)):
        network = Shouting(gain)
        assert bool(is_correct(network(fgsm(network, pictures, labels, epsilon, float32)), labels)) is holds32
        assert bool(is_correct(network(fgsm(network, pictures, labels, epsilon, cross_entropy)), labels)) is holds64
        assert not survives_fgsm(network, pictures, labels, epsilon)
        assert not pgd_outcomes(network, pictures, labels, epsilon)[1]


def test_even_loss_has_the_direction_of_the_mean_loss():
    generator = torch.Generator().manual_seed(0)
    logits = [torch.randn(5, 4, generator=generator, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    labels = [torch.tensor([0, 1, 2, 3, 0]), torch.tensor([3, 2, 1, 0, 0])]
    steered = torch.cat(torch.autograd.grad(balanced_loss(logits, labels, cross_entropy), logits), 1)
    mean = sum(cross_entropy(one, truth).sum() for one, truth in zip(logits, labels, strict=True)) / 2
    plain = torch.cat(torch.autograd.grad(mean, logits), 1)
    assert torch.allclose(steered, plain / plain.abs().amax(1, keepdim=True))


def test_where_epsilon_does_not_reach_all_survive():
    network, pictures, labels = Shouting(10), torch.full((1, 3, 2, 2), 0.52), torch.zeros(1, dtype=torch.long)
    assert survives_fgsm(network, pictures, labels, 0.0199) and pgd_outcomes(network, pictures, labels, 0.0199)[1]
    assert (
        not survives_fgsm(network, pictures, labels, 0.0201) and not pgd_outcomes(network, pictures, labels, 0.0201)[1]
    )


def test_losses_are_what_they_say():
    logits, labels = torch.tensor([[1.0, 3.0, 2.0], [5.0, 0.0, 1.0]]), torch.tensor([2, 0])
    assert margin(logits, labels).tolist() == [1.0, -4.0]
    # -log softmax: log(e^-1 + e^1 + 1) = 1.4076; log(1 + e^-5 + e^-4) = 0.0247
    assert cross_entropy(logits, labels).tolist() == pytest.approx([1.4076, 0.0247], abs=1e-4)
    assert cross_entropy(logits, labels).dtype == torch.float64


def test_pgd_stays_in_the_ball_and_in_range_and_its_first_step_is_a_small_fgsm():
    network = load_builtin().network
    pictures = torch.rand(3, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    labels = torch.tensor([0, 5, 11])
    for number, x in enumerate(pgd(network, pictures, labels, 0.02, cross_entropy, steps=9)):
        assert (x - pictures).abs().max() <= 0.02 + 1e-6 and x.min() >= 0 and x.max() <= 1
        if number == 0:
            assert torch.allclose(x, fgsm(network, pictures, labels, 0.005, cross_entropy), atol=1e-7)
    assert (x - pictures).abs().max() > 0.0199


def test_pictures_are_attacked_each_on_its_own():
    network = load_builtin().network
    pictures = torch.rand(4, 3, 64, 64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        labels = network(pictures).argmax(1)
    together = pgd_outcomes(network, pictures, labels, 0.003, steps=5)[1]
    alone = torch.cat(
        [pgd_outcomes(network, pictures[i : i + 1], labels[i : i + 1], 0.003, steps=5)[1] for i in range(4)]
    )
    assert together.tolist() == alone.tolist()


def test_a_picture_that_was_lost_on_the_way_is_lost():
    def network(pictures):
        x = pictures[:, 0, 0, 0]
        hole = torch.where((x - 0.51).abs() < 0.004, -1000.0, 0.0)  # that steps of 0.0075 from 0.52 fall into
        score = 100 * (x - 0.4) + hole
        return torch.stack([score, -score], 1)

    pictures, labels = torch.full((2, 3, 2, 2), 0.52), torch.tensor([0, 1])
    *_, last = pgd(network, pictures, labels, 0.03, margin)
    assert is_correct(network(last), labels).tolist() == [True, False]
    assert pgd_outcomes(network, pictures, labels, 0.03)[1].tolist() == [False, False]
    assert pgd_outcomes(network, pictures, labels, 0.005)[1].tolist() == [True, False]  # does not reach it
    # what is read wrongly to begin with survives nothing
    assert survives_fgsm(network, pictures, labels, 0.001).tolist() == [True, False]


def test_an_attack_that_stops_early_leaves_what_the_whole_one_takes():
    network, pictures, labels = Shouting(10), torch.full((2, 3, 2, 2), 0.52), torch.tensor([0, 1])
    # steps of 0.0075 from 0.52: 0.5125, 0.505, 0.4975; the second picture is wrong before any
    assert lost_at(network, pictures, labels, 0.03, cross_entropy).tolist() == [3, 0]
    first, alive = pgd_outcomes(network, pictures, labels, 0.03, steps=2)
    assert first.tolist() == [3, 0] and alive.tolist() == [True, False]
    assert lost_at(network, pictures, labels, 0.0199, margin).tolist() == [41, 0]  # does not reach ½


def test_a_random_start_leaves_a_plateau():
    def network(pictures):
        x = pictures[:, 0, 0, 0]
        score = 1 - 100 * torch.relu((x - 0.52).abs() - 0.002)  # no slope at the picture itself
        return torch.stack([score, -score], 1)

    pictures, labels = torch.full((2, 3, 2, 2), 0.52), torch.tensor([0, 0])
    kept, lost = (pgd_outcomes(network, pictures, labels, 0.03, restarts=count) for count in (0, 1))
    assert kept[1].all() and not lost[1].any() and lost[0].tolist() == [41, 41]
    alone = pgd_outcomes(network, pictures[:1], labels[:1], 0.03, restarts=1)
    assert alone[1].tolist() == lost[1].tolist()[:1]
