"""Training without an effect: the views that it sees, what is refused, and what an effect earns and moves, by hand."""

from pathlib import Path

import pytest
import torch

from patchlab.study.study import Cell, Result
from patchlab.validation import ablation
from patchlab.validation.ablation import ALL_EFFECTS, PRINTER, AblationSettings, simplify_problem
from patchproof.base.errors import Refused
from patchproof.channel.printer import load_printer
from patchproof.optimizer import expectation, loop
from patchproof.optimizer.problem import set_problem
from patchproof.render.photograph import expose
from patchproof.scene.conditions import with_values
from test_optimize import scene_with, toml


@pytest.fixture(scope="module")
def problem(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scene")
    return set_problem(scene_with(folder, camera__noise=[0.01, 0.02], camera__photo_px=[160, 120]))


def seen(problem):
    return problem.see(problem.subject.appearance(problem.subject.start()), problem.scene.draw("train", 4), 96)


def test_views_are_seen_without_the_effect_and_otherwise_alike(problem):
    plain, less = seen(problem).conditions, seen(simplify_problem(problem, "noise")).conditions
    assert (plain.sensor.noise > 0).all() and (less.sensor.noise == 0).all()
    assert (plain.pose.azimuth_deg == less.pose.azimuth_deg).all() and (
        plain.sensor.exposure_ev == less.sensor.exposure_ev
    ).all()
    both = seen(simplify_problem(problem, "noise + exposure")).conditions
    assert (both.sensor.noise == 0).all() and (both.sensor.exposure_ev == 0).all()


def test_without_the_printer_colors_are_shown_as_they_are_sent(problem):
    subject = simplify_problem(problem, PRINTER).subject
    green = torch.tensor([0.0, 1.0, 0.0])
    design = green[:, None, None].expand_as(subject.start())
    srgb = subject.appearance(design).srgb
    middle = srgb[srgb.shape[0] // 2, srgb.shape[1] // 2]
    assert middle.tolist() == pytest.approx(green.tolist(), abs=1e-3)
    assert load_printer("coated").apply(design[None])[0, :, 5, 5].tolist() != pytest.approx(green.tolist(), abs=0.1)


def test_views_without_it_are_looked_at_in_the_same_way(problem):
    drawn, shown = problem.scene.draw("evaluate", 2), problem.subject.appearance(problem.subject.start())
    less = simplify_problem(problem, "noise")
    for side_px in (problem.training_px, problem.figure_px):
        by_hand = problem.see(shown, with_values(drawn, noise=0.0), side_px)
        assert torch.equal(expose(less.see(shown, drawn, side_px), shown), expose(by_hand, shown))


def test_training_never_meets_it(problem, monkeypatch):
    met, score = [], expectation.score

    def noting(problem, pictures, conditions, *more):
        met.extend(conditions.sensor.noise)
        return score(problem, pictures, conditions, *more)

    monkeypatch.setattr(expectation, "score", noting)
    next(loop.steps(simplify_problem(problem, "noise")))
    assert len(met) == problem.scene.settings.optimize.views and not any(met)


def test_a_scene_in_which_it_is_off_is_left_out(tmp_path):
    toml(tmp_path / "on.toml", camera__noise=[0.01, 0.02])
    toml(tmp_path / "off.toml", camera__noise=[0, 0])
    settings = AblationSettings(scenes=("on.toml", "off.toml"), effects=("noise", "noise + exposure"))
    cells = [(cell.values["name"], cell.values["effect"]) for cell in ablation.cells(settings, tmp_path)]
    assert cells == [
        *(("on", name) for name in (ALL_EFFECTS, *settings.effects)),
        ("off", ALL_EFFECTS),
        ("off", "noise + exposure"),
    ]


@pytest.mark.parametrize(
    ("effect", "says"), [("motion blur", "a scene in which it is off"), ("smell", "this kind of scene has")]
)
def test_an_effect_that_is_not_there_is_refused(problem, effect, says):
    with pytest.raises(Refused, match=says):
        simplify_problem(problem, effect)


def result_by_hand(seed, effect, **counts):
    """Of so many hits of ten in each world, confidences half as high."""
    answers = {
        world: {"hits": {"design": ["1" * n + "0" * (10 - n)]}, "confidence": {"design": [[n / 20] * 10]}}
        for world, n in counts.items()
    }
    values = {"name": "s", "networks": ["n"], "network": f"n{seed // 2}", "seed": seed, "effect": effect}
    return Result(Cell(f"{seed}{effect}", values), answers, Path())


def test_what_an_effect_earned_and_moved_by_hand():
    settings = AblationSettings(scenes=("s",), networks=("n",), seeds=(0, 1), effects=("noise",), n=10, photos=0)
    counts = ((0, 8, 6, 6), (1, 9, 5, 6), (2, 8, 6, 10), (3, 9, 5, 10))  # seed, with it, without, promised
    results = []
    for seed, whole, less, promised in counts:
        results.append(result_by_hand(seed, ALL_EFFECTS, modeled=whole))
        results.append(result_by_hand(seed, "noise", modeled=less, promised=promised))
    earned, missed, designs = ablation.tables(settings, results)
    ((effect, groups, rate, confidence, *traced),) = earned.rows
    assert (effect, groups, traced) == ("noise", 4, [None, None])
    assert rate.value == pytest.approx(0.3) and confidence.value == pytest.approx(0.15)
    # Student's t of three degrees of freedom, 3.1824, times 0.1 / √3
    assert rate.high - rate.value == pytest.approx(0.1837, rel=1e-3)
    ((_, count, moved, surer, largest, half, outside),) = missed.rows
    assert (count, largest) == (4, -0.5) and 0.1 < half < 0.4
    # pairs were off by -0.05 and -0.45; Student's t of one degree of freedom, 12.706, times 0.2
    assert moved.value == pytest.approx(-0.25) and moved.high - moved.value == pytest.approx(2.541, rel=1e-3)
    assert surer.value == pytest.approx(-0.125) and outside == 2
    assert len(designs.rows) == 8 and designs.rows[0][4] == 0.8 and designs.rows[1][8].value == 0.6
