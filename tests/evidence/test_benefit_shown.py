"""What a verification says first: whether the patch helps; designs that help, are of no use, and do harm."""

from __future__ import annotations

import pytest
from typer.testing import CliRunner

from patchproof.app.cli import app
from patchproof.base.intervals import wilson
from patchproof.base.settings import SceneSettings, background_summary
from patchproof.evidence.benefit import benefit_of
from patchproof.evidence.results import Control
from patchproof.evidence.verdict import PHOTOS_PER_SESSION, judge, next_step, photos_line, sessions_needed
from patchproof.report.words import headline_of, promise_lines, verdict_lines
from patchproof.report.write import report_html
from test_benefit import promise_of as promise_beside
from test_report import some_report
from test_verify_verdict import promise_of


def summary_of(recognized, photos, promise, controls=()):
    """The summary of photographs in sessions of ten."""
    sessions = (10,) * (photos // 10)
    verdict, rate = judge(recognized, sessions, promise), recognized / photos
    return some_report().summary.changed(
        judged=photos,
        photos=photos,
        rate=rate,
        interval=wilson(recognized, photos),
        verdict=verdict.verdict,
        reason=verdict.reason,
        prediction_interval=verdict.prediction_interval,
        worth=benefit_of(rate, wilson(recognized, photos), controls, promise),
    )


def promise_with(rate, bare, low, high, goal="assist"):
    """A promise of 400 conditions with the bare object's rate and the ends of the design's difference to it."""
    promise = promise_beside(rate, {"bare": (bare, low, high)}, goal)
    claim = promise.controls["bare"].changed(interval=wilson(round(400 * bare), 400))
    return promise.changed(controls={"bare": claim})


HELPFUL, HARMFUL = promise_with(0.9, 0.4, 0.42, 0.57), promise_with(0.2, 0.6, -0.5, -0.3)
USELESS = promise_with(0.015, 0.0, -0.01, 0.03)  # keeps what it promises


@pytest.mark.parametrize(
    ("promise", "recognized", "kept", "helps"),
    [
        (HELPFUL, 36, True, True),
        (HELPFUL, 20, False, False),
        (USELESS, 0, True, False),
        (HARMFUL, 8, False, False),
        (promise_with(0.1, 0.6, -0.6, -0.4, "deceive"), 4, True, True),
    ],
)
def test_a_useless_patch_keeps_its_promise_and_is_not_taken_for_one_that_helps(promise, recognized, kept, helps):
    summary = summary_of(recognized, 40, promise)
    assert (summary.meets("kept"), summary.meets("helps")) == (kept, helps)
    assert not summary.changed(worth=None).meets("helps")  # nothing to compare with


@pytest.mark.parametrize(("exits", "how"), [(0, ()), (0, ("--require", "kept")), (1, ("--require", "helps"))])
def test_scripts_can_ask_for_more_than_a_useless_promise_that_held(exits, how, monkeypatch, tmp_path):
    useless = some_report().changed(summary=summary_of(0, 40, USELESS))
    monkeypatch.setattr("patchproof.app.verify.verify", lambda *_, **__: useless)
    done = CliRunner().invoke(app, ["verify", "photos", "--sheet", "a.json", "--out", str(tmp_path), *how])
    assert done.exit_code == exits and done.stdout.startswith("No better than the bare object.")
    assert ("--require helps asks for both" in done.stderr) == ("kept" in how)


@pytest.mark.parametrize(
    ("promise", "recognized", "verdict", "headline", "word"),
    [
        (HELPFUL, 36, "kept", "Helps beside simulated controls", "helps"),
        (USELESS, 0, "kept", "No better than the bare object", "no_better"),
        (HARMFUL, 8, "cannot_tell", "Worse than the bare object", "worse"),
        (HELPFUL, 2, "broken", "Worse than the bare object", "worse"),
        (HELPFUL, 20, "broken", "Not shown to help", "not_shown"),  # 50 % beside 40 %
        (promise_with(0.1, 0.6, -0.6, -0.4, "deceive"), 4, "kept", "Deceives beside simulated controls", "helps"),
        (promise_with(0.9, 0.6, 0.2, 0.4, "deceive"), 36, "cannot_tell", "Worse than the bare object", "worse"),
    ],
)
def test_terminal_and_page_begin_with_what_the_patch_is_worth(promise, recognized, verdict, headline, word):
    summary = summary_of(recognized, 40, promise)
    report = some_report().changed(summary=summary)
    assert (summary.verdict, headline_of(summary.model_dump()), summary.worth.word) == (verdict, headline, word)
    first, second = verdict_lines(report)[:2]
    assert first.startswith(f"{headline}. Recognized in {recognized / 40:.1%} of 40 photographs, the bare object in")
    assert "not photographed" in first and second.startswith(f"verdict: {verdict} ")
    manifest = {"promise": promise.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    page = report_html(report.model_dump(mode="json"), manifest | {"design": None}, {}, None)
    assert f'<h1 class="{word}">{headline}</h1>' in page and page.index(headline) < page.index("Promise ")
    assert ".helps { color:var(--yes) }" in page and f'<b class="{verdict}">Promise ' in page


def test_photographed_controls_come_before_simulated_ones_and_the_bare_object_before_others():
    def beside(name, recognized):
        low = 0.5 - recognized / 40 - 0.2
        return Control(name, recognized, 40, (0, 1), 0, 0.5 - recognized / 40, (low, low + 0.4), 4, "", low > 0)

    interval = wilson(20, 40)
    assert benefit_of(0.5, interval, [beside("bare", 4)], HARMFUL).word == "helps"
    worth = benefit_of(0.5, interval, [beside("gray", 22), beside("bare", 18)], HELPFUL)
    assert (worth.control, worth.word, worth.photographed) == ("bare", "not_shown", True)
    assert benefit_of(0.5, interval, [Control("bare", 0, 0, (0, 1))], HELPFUL).photographed is False
    assert benefit_of(0.5, interval, (), promise_of(0.9).changed(controls={})) is None


@pytest.mark.parametrize(("high", "word"), [(0.099, "no_better"), (0.101, "not_shown")])
def test_a_gain_of_ten_points_that_is_not_ruled_out_is_not_shown(high, word):
    control = Control("bare", 20, 40, (0, 1), 0, 0.0, (-0.1, high), 4, "", False)
    assert benefit_of(0.5, (0.3, 0.7), [control], HELPFUL).word == word


def test_who_cannot_tell_is_told_how_many_photographs_the_plan_asks_for():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    needed = sessions_needed(promise)
    assert needed and f"{PHOTOS_PER_SESSION} photographs in each of {needed} places" in next_step(promise, (6,))
    assert f"So far: 6 of {PHOTOS_PER_SESSION * needed}, in 1 place of {needed}." in next_step(promise, (6,))
    assert next_step(promise, ()) == photos_line(needed) and "So far" not in photos_line(needed)
    assert "new" in next_step(promise, (PHOTOS_PER_SESSION,) * needed) and "So far" not in next_step(
        promise, (PHOTOS_PER_SESSION,) * needed
    )
    assert "gains more" in next_step(promise_of(0.3, 0.28, correlation=0.2), (40,))
    assert "markers" in next_step(promise, (20,), 3) and "markers" not in next_step(promise, (20,), 2)
    report = some_report().changed(summary=some_report().summary.changed(next_step="Take 10."))
    assert "Take 10." in verdict_lines(report)


def test_what_stood_behind_the_object_is_said_and_a_plain_color_loudly():
    scene = {
        "object": {"mesh": "primitive:mug", "length_mm": 100},
        "patch": {"width_mm": 50, "height_mm": 50},
        "target": {"label": "mug", "models": ["builtin"]},
    }

    def said(background):
        return background_summary(
            SceneSettings.model_validate(scene | {"background": background}).model_dump(mode="json")
        )

    assert said({}) == "procedural rooms" and said({"images": "a/yards"}) == "pictures (yards)"
    assert said({"color": (0.5, 0.5, 0.5)}).startswith("ONE PLAIN COLOR")
    assert (
        background_summary({"object": {"photos": "x"}}) == "the scene's own pictures" and background_summary({}) == ""
    )
    plain = said({"color": (0.5, 0.5, 0.5)})
    report = some_report().changed(summary=some_report().summary.changed(background=plain))
    assert any("ONE PLAIN COLOR" in line for line in verdict_lines(report))
    assert any("ONE PLAIN COLOR" in line for line in promise_lines(HELPFUL, plain))
    manifest = {"promise": HELPFUL.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    assert "ONE PLAIN COLOR" in report_html(report.model_dump(mode="json"), manifest | {"design": None}, {}, None)


@pytest.mark.parametrize("views", [0, 48])
def test_that_the_promise_is_a_draft_is_said(views):
    summary = some_report().summary.changed(background="procedural rooms", draft_views=views)
    report = some_report().changed(summary=summary)
    promise = HELPFUL.changed(draft=views > 0)
    manifest = {"promise": promise.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    page = report_html(report.model_dump(mode="json"), manifest | {"design": None}, {}, None)
    assert ("The promise is a draft of 48 views, no more than a hint." in page) == (views > 0)
    line = "promised before procedural rooms"
    hint = f"{line}, a draft of 48 views and no more than a hint"
    assert (hint if views else line) in verdict_lines(report)
