"""Training without an effect: the views that it sees, what is refused, and what an effect has earned, by hand."""

import time
from pathlib import Path

import pytest
import torch

from patchlab.study.study import Cell, Result
from patchlab.validation import ablation
from patchlab.validation.ablation import ALL, PRINTER, AblationSettings, without
from patchproof.base.strict import Refused
from patchproof.channel.printer import load_printer
from patchproof.optimizer.problem import set_problem
from test_optimize import scene_with


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    return set_problem(scene_with(folder, camera__noise=[0.01, 0.02], camera__photo_px=[160, 120]))


def seen(problem):
    return problem.see(problem.subject.shown(problem.subject.start()), problem.scene.draw("train", 4), 96)


def test_views_are_seen_without_the_effect_and_otherwise_alike(problem):
    plain, less = seen(problem).conditions, seen(without(problem, "noise")).conditions
    assert (plain.sensor.noise > 0).all() and (less.sensor.noise == 0).all()
    assert (plain.pose.azimuth_deg == less.pose.azimuth_deg).all() and (
        plain.sensor.exposure_ev == less.sensor.exposure_ev
    ).all()
    both = seen(without(problem, "noise + exposure")).conditions
    assert (both.sensor.noise == 0).all() and (both.sensor.exposure_ev == 0).all()


def test_without_the_printer_colors_are_shown_as_they_are_sent(problem):
    subject = without(problem, PRINTER).subject
    green = torch.tensor([0.0, 1.0, 0.0])
    design = green[:, None, None].expand_as(subject.start())
    srgb = subject.shown(design).srgb
    middle = srgb[srgb.shape[0] // 2, srgb.shape[1] // 2]
    assert middle.tolist() == pytest.approx(green.tolist(), abs=1e-3)
    assert load_printer("coated").apply(design[None])[0, :, 5, 5].tolist() != pytest.approx(green.tolist(), abs=0.1)


def test_an_effect_that_takes_time_costs_a_share_of_a_step(problem, monkeypatch):
    slow = ablation.Without.see
    monkeypatch.setattr(ablation.Without, "see", lambda *a: (time.sleep(0.3), slow(*a))[1])
    monkeypatch.setattr(ablation, "ROUNDS", 1)
    costs = ablation._costs(problem, ["noise"])
    assert list(costs) == ["noise"] and costs["noise"] < -0.5  # without it, a step takes far longer


@pytest.mark.parametrize(("effect", "says"), [("lamp", "with lamp in it"), ("smell", "this kind of scene has")])
def test_an_effect_that_is_not_there_is_refused(problem, effect, says):
    with pytest.raises(Refused, match=says):
        without(problem, effect)


def test_what_an_effect_earned_by_hand():
    settings = AblationSettings(scenes=("s",), networks=("n",), seeds=(0, 1), effects=("noise",), n=10, photos=0)
    results = []
    for seed, counts in enumerate(((8, 6), (9, 5))):
        for effect, count in zip((ALL, "noise"), counts, strict=True):
            hits = "1" * count + "0" * (10 - count)
            answers = {"modeled": {"hits": {"design": [hits]}, "confidence": {"design": [[count / 20] * 10]}}}
            answers["cost"] = {"noise": 0.1 + 0.2 * seed} if effect == ALL else {}
            values = {"name": "s", "networks": ["n"], "network": "n", "seed": seed, "effect": effect}
            results.append(Result(Cell(f"{seed}{effect}", values), answers, Path()))
    earned, designs = ablation.tables(settings, results)
    ((effect, groups, rate, confidence, *traced, cost),) = earned.rows
    assert (effect, groups, traced) == ("noise", 2, [None, None]) and cost.value == pytest.approx(0.2)
    assert rate.value == pytest.approx(0.3) and confidence.value == pytest.approx(0.15)
    # Student's t of one degree of freedom, 12.706, times 0.1
    assert rate.high - rate.value == pytest.approx(1.2706, rel=1e-3)
    assert len(designs.rows) == 4 and designs.rows[0][4] == 0.8
