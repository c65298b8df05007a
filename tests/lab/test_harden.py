"""Assistive images: what changes, by how much, what is written, and the table beside it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_networks import RedAgainstBlue
from PIL import Image

from patchlab import cli
from patchlab.harden.attacks import margin, pgd_outcomes
from patchlab.harden.harden_study import HardenSettings, attack_failed, harden_images, tables
from patchlab.harden.hardening import center_squares, harden, image_change
from patchlab.study.study import Cell, Result, Work, run_study
from patchproof.base.errors import Refused
from patchproof.base.validation import validate_model
from patchproof.classifier.network import Classifier
from patchproof.photo.read import read_photo

FAKE = "module:fake_networks.red_against_blue"
RED = Classifier("red", None, 32, RedAgainstBlue.labels, RedAgainstBlue())


def noise(height, width, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


@pytest.mark.parametrize("method", ["pgd", "fgsm", "adam"])
@pytest.mark.parametrize("epsilon", [1 / 255, 8 / 255, 0.1, None])
def test_the_true_class_gains_inside_of_the_ball_and_nothing_else_moves(method, epsilon):
    photos = [noise(40, 70), noise(32, 32, 1)]
    labels = [[1, 0]]  # blue, red
    hardened = harden(photos, labels, [RED], method, epsilon, 10)
    before, after = (margin(RED.network(center_squares(p, RED)), torch.tensor(labels[0])) for p in (photos, hardened))
    assert (after < before).all()
    for photo, picture in zip(photos, hardened, strict=True):
        assert picture.shape == photo.shape and picture.dtype == np.uint8
        change = np.abs(picture.astype(int) - photo.astype(int)).max()
        assert 0 < change <= (255 if epsilon is None else int(epsilon * 255 + 1e-6))  # 0.1 is 25.5 code values
    moved_columns = (hardened[0] != photos[0]).any((0, 2)).nonzero()[0]
    assert moved_columns.min() >= 15 and moved_columns.max() < 55  # the centered square of 40×70


def test_pgd_on_a_linear_network_reaches_the_ball_and_iterated_fgsm_ends_there():
    photo = np.full((32, 32, 3), 128, np.uint8)
    for method, steps in (("pgd", 4), ("fgsm", 7)):
        (picture,) = harden([photo], [[0]], [RED], method, 8 / 255, steps)
        middle = picture[12:20, 12:20]
        assert (middle[..., 0] == 136).all() and (middle[..., 1] == 128).all() and (middle[..., 2] == 120).all()


def test_photographs_do_not_depend_on_their_company():
    photos = [noise(40, 60, seed) for seed in range(3)]
    together = harden(photos, [[0, 1, 0]], [RED], "adam", 0.1, 5)
    for photo, label, picture in zip(photos, [0, 1, 0], together, strict=True):
        (alone,) = harden([photo], [[label]], [RED], "adam", 0.1, 5)
        assert (alone == picture).all()


def test_moved_is_zero_and_one_for_the_same_and_rms_is_the_root_mean_square():
    photo = noise(40, 50) // 2
    assert image_change(photo, photo) == pytest.approx((0, 1), abs=1e-6)
    assert image_change(photo, photo + 51)[0] == pytest.approx(0.2)
    # by definition (Wang et al. 2004) flat pictures of means a and b have SSIM (2ab + C1) / (a² + b² + C1), C1 = 1e-4
    a, b = np.full((40, 40, 3), 51, np.uint8), np.full((40, 40, 3), 102, np.uint8)
    assert image_change(a, b)[1] == pytest.approx((2 * 0.08 + 1e-4) / (0.04 + 0.16 + 1e-4), abs=1e-4)


def test_attacks_that_leave_more_than_weaker_ones_are_flagged():
    survivors = {("clean", 0.0): 9, ("fgsm", 0.01): 5, ("fgsm", 0.02): 6, ("pgd", 0.01): 4, ("pgd", 0.02): 5}
    flagged = [condition for condition in survivors if attack_failed(condition, survivors)]
    assert flagged == [("fgsm", 0.02), ("pgd", 0.02)]
    assert attack_failed(("pgd", 0.01), {("clean", 0.0): 9, ("fgsm", 0.01): 3, ("pgd", 0.01): 4})
    assert not attack_failed(("pgd", 0.01), {("fgsm", 0.02): 3, ("pgd", 0.01): 4})  # neither is the weaker


@pytest.fixture
def folder(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    Image.fromarray(noise(48, 64)).save(photos / "a.jpg", quality=95)
    Image.fromarray(noise(32, 32, 1)).save(photos / "a.png")
    Image.fromarray(noise(50, 40, 2)).save(photos / "b.png")
    (photos / "broken.png").write_text("no picture")
    Image.fromarray(noise(4, 40, 2)).save(photos / "thin.png")
    (photos / "labels.csv").write_text("file,label\na.jpg,red\na.png,blue\nb.png,1\nbroken.png,red\nthin.png,red\n")
    return photos


def options(folder, **changed):
    given = {"images": str(folder), "labels": str(folder / "labels.csv"), "models": [FAKE], "steps": 3}
    return validate_model(HardenSettings, given | {"attack_epsilons": [0.01]} | changed, "test")


def test_the_command_keeps_names_and_sizes_and_writes_a_table(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["harden", str(folder), "--labels", str(folder / "labels.csv"), "--models", FAKE, "--out", str(out)]
    arguments += ["--eps", "8/255", "--steps", "3", "--evaluate", "fgsm,pgd", "--attack-eps", "0.01"]
    with pytest.raises(SystemExit) as left:
        cli.app(arguments)
    assert left.value.code == 0
    sizes = {path.name: read_photo(path).srgb.shape[:2] for path in out.glob("*.png")}
    assert sizes == {"a.jpg.png": (48, 64), "a.png.png": (32, 32), "b.png": (50, 40)}
    assert (out / "labels.csv").read_text() == "file,label\na.jpg.png,red\na.png.png,blue\nb.png,1\n"
    said = capsys.readouterr().out
    assert "pgd 0.01" in said and "broken.png" in said and "thin.png" in said
    rows = list(csv.DictReader((out / "harden_accuracy.csv").read_text().splitlines()))
    assert [row["attack"] for row in rows] == ["clean", "fgsm 0.01", "pgd 0.01"]
    assert all(row["hardened_n"] == "3" for row in rows)
    # what the table says of the clean images is what the files say
    written = [read_photo(out / name).srgb for name in ("a.jpg.png", "a.png.png", "b.png")]
    truth = RED.network(center_squares(written, RED)).argmax(1).tolist()
    assert float(rows[0]["hardened"]) == pytest.approx(np.mean([a == b for a, b in zip(truth, [0, 1, 1], strict=True)]))


def test_resuming_and_originals_in_the_way(folder, tmp_path):
    out = tmp_path / "out"
    settings = options(folder, epsilons=["none"], attacks=["fgsm"])
    harden_images(settings, out)
    table, picture = (out / "harden_accuracy.csv").read_bytes(), (out / "b.png").read_bytes()
    (out / "b.png").unlink()
    harden_images(settings, out, Work(resume=True))
    assert (out / "b.png").read_bytes() == picture and (out / "harden_accuracy.csv").read_bytes() == table
    harden_images(settings, out, Work(overwrite=True))
    with pytest.raises(Refused, match="inputs that lie outside of what is written"):
        harden_images(settings, folder, Work(overwrite=True))
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "mine.png").touch()
    with pytest.raises(Refused, match=r"mine\.png"):
        harden_images(settings, mine, Work(overwrite=True))


@pytest.mark.parametrize("name", ["../photos/b.png", "{folder}/b.png"])
def test_names_that_lead_out_of_the_folder_are_refused(folder, tmp_path, name):
    """Their PNGs would have been written there."""
    table, before = tmp_path / "labels.csv", sorted(folder.iterdir())
    table.write_text(f"{name.format(folder=folder)},red\n")
    with pytest.raises(Refused, match="names of files within"):
        harden_images(options(folder, labels=str(table)), tmp_path / "out")
    with pytest.raises(Refused, match="inputs that lie outside"):  # beside which PNGs would lie
        harden_images(options(folder), folder.parent)
    assert sorted(folder.iterdir()) == before and not (tmp_path / "out").exists()


def test_the_study_varies_networks_and_epsilons(folder, tmp_path):
    config = tmp_path / "harden.toml"
    config.write_text(
        f'images = "photos"\nlabels = "photos/labels.csv"\nmodels = ["{FAKE}"]\nsteps = 2\n'
        'epsilons = ["8/255", 0.1, "none"]\nmethods = ["pgd", "adam"]\nattacks = ["pgd"]\nattack_epsilons = [0.01]\n'
    )
    finished = run_study("harden", config, tmp_path / "out")
    assert not finished.failed
    assert len(list((tmp_path / "out/images").glob("*/b.png"))) == 6
    rows = finished.tables[0].rows
    assert [row[2:4] for row in rows[::2]] == [(m, e) for m in ("pgd", "adam") for e in ("8/255", "0.1", "none")]
    moved_rows = finished.tables[1].rows
    assert all(row[4] <= 0.1 for row in moved_rows if row[2] != "none")
    assert json.loads((tmp_path / "out/harden.json").read_text())["settings"]["epsilons"][2] is None


def test_pgd_is_told_at_early_stops_on_photographs_spread_over_the_table(folder, tmp_path):
    changed = {"epsilons": [0.1], "attacks": ["pgd"], "attack_epsilons": [0.3], "attack_steps": 6}
    settings = options(folder, **changed, photos=2, keep_images=False, restarts=1)
    finished = harden_images(settings, tmp_path / "out")
    assert [photo["file"] for photo in finished.results[0].cell.values["photos"]] == ["a.jpg", "b.png"]
    assert not list((tmp_path / "out").glob("*.png"))
    early = next(table for table in finished.tables if table.name == "early")
    at = early.head.index("after 1")
    for row in early.rows:
        rates = [each.value for each in row[at:]]
        assert rates == sorted(rates, reverse=True) and rates[-1] == 0  # the ball reaches over the boundary
    before, after = early.rows
    assert after[at].value > before[at].value and after[at].n == 2


def test_gains_by_class_are_means_of_the_classes_means(folder, tmp_path):
    settings = options(folder, epsilons=[0.1], attacks=["fgsm"])
    labels, before, after = "aaabcde", [0, 0, 0, 1, 1, 0, 0], [1, 1, 1, 1, 0, 0, 1]

    def result(hits, values):
        rows = [
            {"file": str(i), "label": label, "right": {FAKE: [True, bool(hit)]}, "lost_at": {}, "rms": 0.0, "ssim": 1.0}
            for i, (label, hit) in enumerate(zip(labels, hits, strict=True))
        ]
        return Result(Cell("cell", values), {"photos": rows, "unread": []}, tmp_path)

    variant = {"models": [FAKE], "method": "pgd", "epsilon": 0.1}
    accuracy, *_ = tables(settings, [result(before, {}), result(after, {"variant": variant})])
    clean, fgsm = (dict(zip(accuracy.head, row, strict=True)) for row in accuracy.rows)
    assert fgsm["gain"].value == pytest.approx(3 / 7) and fgsm["gain"].n == 7
    # class a gains 1, b 0, c -1, d 0, e 1
    assert fgsm["gain by class"].value == pytest.approx(1 / 5) and fgsm["gain by class"].n == 5
    assert clean["gain by class"].value == 0


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"epsilons": ["1/256"]}, "1/255 to 1"),
        ({"epsilons": ["much"]}, "must be a number"),
        ({"models": []}, "models"),
        ({"attacks": ["cw"]}, "attacks"),
        ({"attack_epsilons": [0]}, "attack_epsilons"),
        ({"step": 3}, 'did you mean "steps"'),
    ],
)
def test_settings_that_will_not_do(folder, changed, words):
    with pytest.raises(Refused, match=words):
        options(folder, **changed)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("a.jpg,red\ngone.png,red", r"1 missing \(gone\.png\)"),
        ("a.jpg,red\na.jpg,blue", "twice"),
        ("a.jpg,green", "label that the network knows"),
        ("file,label", "a table without rows"),
    ],
)
def test_tables_that_will_not_do(folder, tmp_path, table, words):
    (folder / "labels.csv").write_text(table)
    with pytest.raises(Refused, match=words):
        harden_images(options(folder), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_steps_that_fall_settle_where_the_loss_is_least():
    """The loss is least at a gray of 0.6; steps of 0.05 to the end would swing between 0.563 and 0.613."""

    def near(photos):
        off = (photos.mean((1, 2, 3)) - 0.6).square()[:, None]
        return torch.cat([-100 * off, torch.zeros_like(off)], 1)

    classifier = replace(RED, network=near)
    photo = np.full((32, 32, 3), 118, np.uint8)
    (picture,) = harden([photo], [[0]], [classifier], "pgd", 0.2, 40)
    assert abs(center_squares([picture], classifier).mean().item() - 0.6) < 0.006


def test_through_the_attack_steps_go_where_the_attacked_loss_falls():
    """The network shouts at a gray of 0.6 and is calm and right above 0.7: attacked by 0.05, one must go there."""

    def peaked(photos):
        x = photos.mean((1, 2, 3))
        score = 20 * torch.exp(-(((x - 0.6) / 0.02) ** 2)) + 4 * torch.sigmoid((x - 0.7) * 40) - 2
        return torch.stack([score, -score], 1)

    classifier = replace(RED, network=peaked)
    photo = np.full((32, 32, 3), round(0.62 * 255), np.uint8)
    near, far = (
        center_squares(harden([photo], [[0]], [classifier], "pgd", 0.15, 40, through=through), classifier)
        for through in (None, 0.05)
    )
    assert abs(near.mean().item() - 0.6) < 0.01 and far.mean().item() > 0.75
    labels = torch.tensor([0])
    assert not pgd_outcomes(peaked, near, labels, 0.05)[1] and pgd_outcomes(peaked, far, labels, 0.05)[1]


@pytest.mark.parametrize("through", [0, 1.5])
def test_an_attack_to_go_through_has_an_epsilon(folder, through):
    with pytest.raises(Refused, match="through"):
        options(folder, through=through)
