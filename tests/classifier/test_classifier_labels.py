"""What a classifier sees, which output is meant, and what counts as recognized."""

import numpy as np
import pytest
import torch
from PIL import Image
from pydantic import ValidationError

from patchproof.base.errors import Refused
from patchproof.base.settings import TargetSettings
from patchproof.classifier import Classifier, center_square, find_labels, load_classifier
from patchproof.classifier.labels import refuse_different_entries

LABELS = ("jeep, landrover", "crane", "crane", "box truck", "maillot", "maillot, tank suit", "mouse, computer mouse")


def test_a_square_of_the_right_size_comes_back_unchanged():
    photos = torch.rand(2, 3, 224, 224)
    assert torch.equal(center_square(photos, 224), photos)
    wide = torch.rand(1, 3, 224, 300)
    assert torch.equal(center_square(wide, 224), wide[..., 38:262])
    assert torch.equal(center_square(wide.mT, 224), center_square(wide, 224).mT)


def test_the_centered_square_is_what_pillow_makes_of_it():
    photo = np.random.default_rng(0).integers(0, 256, (301, 412, 3), dtype=np.uint8)
    square = Image.fromarray(photo).crop((55, 0, 356, 301)).resize((96, 96), Image.Resampling.BILINEAR)
    ours = center_square(torch.from_numpy(photo).permute(2, 0, 1)[None].float() / 255, 96)
    # Pillow rounds to 8 bits after each of its two passes
    assert np.abs(ours[0].permute(1, 2, 0).numpy() * 255 - np.asarray(square)).max() <= 1.01


def test_fine_stripes_average_instead_of_aliasing():
    stripes = (torch.arange(1024) % 2).float().expand(1, 3, 1024, 1024)
    small = center_square(stripes, 100)
    assert (small - 0.5).abs().max() < 0.06
    plain = torch.nn.functional.interpolate(stripes, (100, 100), mode="bilinear", align_corners=False)
    assert (plain - 0.5).abs().max() > 0.3  # what the test would see without antialiasing


def test_the_gradient_of_the_square_is_its_finite_difference():
    photo = torch.rand(1, 1, 9, 13, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda x: center_square(x, 4), photo)


def test_labels_by_index_name_case_and_underscore():
    assert find_labels(LABELS, 3) == (3,)
    assert (
        find_labels(LABELS, "jeep")
        == find_labels(LABELS, "LandRover")
        == find_labels(LABELS, "jeep, landrover")
        == (0,)
    )
    assert find_labels(LABELS, "box_truck", ["tank suit", 0, "Box Truck"]) == (3, 5, 0)


@pytest.mark.parametrize(
    ("label", "sentence"),
    [
        ("crane", '"crane", which is in 2 labels: use the index 1 \\("crane"\\) or 2'),
        ("maillot", 'which is in 2 labels: use the index 4 \\("maillot"\\) or 5 \\("maillot, tank suit"\\)'),
        ("land rover", 'did you mean "landrover"'),
        ("truck", '"truck": did you mean "box truck"'),
        ("zzz", "use an index below 7 or one of its 7 labels"),
        (7, "from 0 to 6, got 7"),
        (-1, "got -1"),
    ],
)
def test_labels_that_are_absent_or_not_unique_are_refused(label, sentence):
    with pytest.raises(Refused, match=sentence):
        find_labels(LABELS, label)
    with pytest.raises(Refused, match=sentence):
        find_labels(LABELS, 0, [label])


def test_confidence_is_the_summed_softmax_in_double_precision():
    logits = torch.tensor([[0.0, 0.0, 0.0], [40.0, 0.0, 0.0]])
    network = Classifier("none", None, 8, ("a", "b", "c"), lambda x: x)
    assert network.confidence(logits, (0,)).tolist() == [1 / 3, 1 / (1 + 2 * np.exp(-40))]
    assert network.confidence(logits, (1, 2))[1] == pytest.approx(
        2 * np.exp(-40), rel=1e-12
    )  # float32 would have room for less
    assert network.recognized(logits, (1, 0)).tolist() == [True, True]
    assert network.recognized(logits, (2,)).tolist() == [False, False]


def test_logits_are_those_of_the_centered_square():
    classifier = Classifier("mean", None, 8, ("red", "green", "blue"), lambda x: x.mean((2, 3)))
    photo = torch.zeros(1, 3, 16, 48)
    photo[:, 0, :, 16:32] = 1  # red in the middle, black beside it
    torch.testing.assert_close(classifier.logits(photo), torch.tensor([[1.0, 0.0, 0.0]]))
    assert classifier.recognized(classifier.logits(photo), (0,)).all()


def test_an_index_is_one_thing_in_all_networks():
    networks = (("cat", "jeep, landrover"), ("dog", "Jeep"), ("cow", "landrover"))
    refuse_different_entries(networks, 1)
    refuse_different_entries(networks, "cat")
    refuse_different_entries((), 99)  # that no network has: said elsewhere
    with pytest.raises(Refused, match='got 0, which is "cat" in one of them and "dog" in another: give its name'):
        refuse_different_entries(networks, 0)


def test_true_is_no_label():
    with pytest.raises(ValidationError, match="label"):
        TargetSettings(label=True, models=("builtin",))


@pytest.mark.parametrize("where", ["", "def factory():\n    "])
def test_a_factory_that_ends_the_program_is_refused(tmp_path, where):
    name = f"ends_{len(where)}"
    (tmp_path / f"{name}.py").write_text(f"{where}raise SystemExit(0)\n")
    with pytest.raises(Refused, match=r"SystemExit|an import that fails"):
        load_classifier(f"module:{name}.factory", tmp_path)
