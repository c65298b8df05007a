"""What a design is worth beside its best control: the word, the first line, the page, and who asks for better."""

from __future__ import annotations

import re

import numpy as np
import pytest
from synthetic_photos import promised_conditions
from typer.testing import CliRunner

from patchproof.app.cli import app
from patchproof.report.words import promise_lines
from patchproof.sheets.content import SheetContent
from patchproof.sheets.manifest import Promise
from patchproof.sheets.piece import lay_out_piece


def promise_of(rate: float, controls: dict[str, tuple[float, float, float]], goal: str = "assist") -> Promise:
    """Controls are (rate, low, high), the ends of the design's difference to them."""
    claim = {"interval": (0, 1), "confidence": 0.5}
    return Promise(
        target={"label": "jeep", "indices": (1,), "goal": goal},
        models=[{"name": "m", "sha256": None, "rate": rate, **claim}],
        rate=rate,
        interval=(0, 1),
        n=400,
        controls={
            name: {"n": 400, "rate": own, "difference": rate - own, "difference_interval": (low, high), **claim}
            for name, (own, low, high) in controls.items()
        },
        conditions=promised_conditions(400, rate),
    )


def test_the_headline_compares_the_views_that_both_were_shown_in():
    """Controls are shown in some of the views, in which the design has another rate than the promised one: it stands
    in each control's own line only.
    """
    promise = promise_of(0.825, {"bare": (0.95, -0.24, 0.13)})
    claim = promise.controls["bare"].changed(difference=-0.05)
    promise = promise.changed(controls={"bare": claim.changed(n=100)})
    told = "-5.0 points [-24.0, +13.0]"
    assert promise.headline == f"cannot be told yet: {told} beside its best control (bare) in the same 100 views."
    _, rate, bare = promise_lines(promise, {})
    assert "recognized in 82.5% of 400" in rate and bare == f"    bare:  95.0%, design 90.0% in the same 100: {told}"


@pytest.mark.parametrize(("rate", "control"), [(0.875, 0.5417), (0.8125, 0.5724), (0.0046, 0.0012)])
def test_a_printed_difference_is_that_of_the_printed_rates(rate, control):
    *_, line = promise_lines(promise_of(rate, {"bare": (control, 0.1, 0.3)}), {})
    printed = re.findall(r"[-+]?\d+\.\d", line)
    assert float(printed[2]) == pytest.approx(float(printed[1]) - float(printed[0]), abs=1e-9)


@pytest.mark.parametrize(
    ("controls", "goal", "best", "worth"),
    [
        ({"bare": (0.4, 0.05, 0.2), "gray": (0.1, 0.3, 0.5)}, "assist", "bare", "helps"),
        ({"bare": (0.4, 0.0, 0.2), "gray": (0.1, 0.3, 0.5)}, "assist", "bare", "cannot_tell"),
        ({"bare": (0.4, -0.4, 0.1), "gray": (0.1, -0.6, 0.5)}, "assist", "bare", "cannot_tell"),  # as drafts are
        ({"bare": (0.4, 0.01, 0.09), "gray": (0.1, 0.3, 0.5)}, "assist", "bare", "does_not_help"),  # too little
        ({"bare": (0.4, 0.0, 0.2), "gray": (0.1, -0.3, 0.09)}, "assist", "gray", "does_not_help"),
        ({"bare": (0.6, -0.2, -0.01), "gray": (0.1, 0.3, 0.5)}, "assist", "bare", "does_not_help"),
        ({"bare": (0.8, -0.4, -0.2), "gray": (0.6, -0.2, -0.05)}, "deceive", "gray", "helps"),
        ({"bare": (0.8, -0.4, -0.2), "gray": (0.4, 0.05, 0.2)}, "deceive", "gray", "does_not_help"),
    ],
)
def test_the_hardest_control_decides_and_its_interval_says_the_word(controls, goal, best, worth):
    promise = promise_of(0.5, controls, goal)
    assert (promise.best_control, promise.answer) == (best, worth)
    first = promise_lines(promise, {}, "my run")[0]
    verb = "help" if goal == "assist" else "deceive"
    words = {"helps": f"{verb}s", "does_not_help": f"does not {verb}", "cannot_tell": "cannot be told yet"}
    assert first.startswith(f"{words[worth]}: ") and f"beside its best control ({best})" in first
    assert ("Try another" in first) == (worth == "does_not_help")
    assert ("What tells: patchproof promise 'my run' --n 1600." in first) == (worth == "cannot_tell")


@pytest.mark.parametrize(
    ("settings", "change"),
    [
        ({"object": {"mesh": "a"}}, "place, size or seed"),
        ({"object": {"mesh": "a"}, "patch": {"kind": "texture"}}, "seed, or let more of the surface change"),
        ({"object": {"images": "a"}}, "size or seed"),
        ({"object": {"mesh": "a"}, "imported": {"file": "a.png"}}, "place, size or picture"),
    ],
)
def test_a_draft_that_cannot_tell_names_the_command_and_advice_fits_the_kind(settings, change):
    draft = promise_of(0.5, {"bare": (0.3, -0.05, 0.45)}).changed(draft=True)
    said = promise_lines(draft, settings, "r")[0]
    assert said.startswith("Draft of 400 views (preliminary): cannot be told yet") and "Try another" not in said
    assert said.endswith("What tells: patchproof promise r.")
    useless = promise_of(0.3, {"bare": (0.3, -0.05, 0.05)})
    assert f"10 points or more is ruled out. Try another {change}." in promise_lines(useless, settings)[0]


def test_the_page_says_so_in_its_first_line():
    piece = lay_out_piece((100, 100), 10, "A" * 10, "design")
    design = np.full((8, 8, 3), 128, np.uint8)
    kinds = [
        SheetContent(piece, "A" * 10, "design", design, promise_of(0.5, {"bare": ends})).words["kind"]
        for ends in ((0.4, 0.05, 0.2), (0.5, -0.1, 0.1), (0.6, -0.2, -0.05))
    ]
    assert kinds == ["design", "design, effect unknown", "design, does not help"]


def test_a_design_that_is_not_known_to_help_exits_with_1_only_where_that_is_asked(tmp_path, monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 8)
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)
    scene = tmp_path / "scene.toml"
    scene.write_text(
        '[object]\nmesh = "primitive:carton"\nlength_mm = 300\n[patch]\nwidth_mm = 60\nheight_mm = 60\n'
        '[target]\nlabel = "mug"\nmodels = ["builtin"]\n[camera]\nphoto_px = [96, 96]\n'
        "[optimize]\nsteps = 1\nviews = 1\n[background]\ncolor = [0.5, 0.5, 0.5]\n"
    )

    def run(name, *more):
        return CliRunner().invoke(app, ["optimize", str(scene), "--out", str(tmp_path / name), *more])

    asked = run("a", "--require", "helps")
    assert asked.exit_code == 1 and "next: patchproof sheet" not in asked.stdout
    assert re.search(r"cannot be told yet.*What tells: patchproof promise|does not help.*ruled out", asked.stdout)
    assert (tmp_path / "a" / "run.json").is_file()
    assert run("b").exit_code == 0
    assert run("c", "--require", "better").exit_code == 2
