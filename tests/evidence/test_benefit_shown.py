"""What a verification says first: whether the patch helps; designs that help, are of no use, and do harm."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from patchproof.app.cli import app
from patchproof.base.goal import Goal
from patchproof.base.intervals import wilson
from patchproof.base.sessions import session_difference
from patchproof.base.settings import SceneSettings, background_summary
from patchproof.evidence.results import Control, EffectEstimate
from patchproof.evidence.verdict import (
    PHOTOS_PER_SESSION,
    benefit_of,
    judge,
    photos_line,
    sessions_needed,
    sessions_to_show,
    still_needed,
)
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
        worth=benefit_of(photos, rate, wilson(recognized, photos), controls, promise),
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
    monkeypatch.setattr("patchproof.app.cli.files.check_files", lambda arguments: None)
    done = CliRunner().invoke(app, ["verify", "photos", "--sheet", "a.json", "--out", str(tmp_path), *how])
    assert done.exit_code == exits and done.stdout.startswith("Does not help (controls simulated).")
    assert ("--require helps needs both" in done.stderr) == ("kept" in how)


@pytest.mark.parametrize(
    ("promise", "recognized", "verdict", "headline", "word"),
    [
        (HELPFUL, 36, "kept", "Helps", "helps"),
        (USELESS, 0, "kept", "Does not help", "does_not_help"),
        (HARMFUL, 8, "cannot_tell", "Does not help", "does_not_help"),
        (HELPFUL, 2, "broken", "Does not help", "does_not_help"),
        (HELPFUL, 20, "broken", "Cannot be told yet", "cannot_tell"),  # 50 % beside 40 %
        (promise_with(0.1, 0.6, -0.6, -0.4, "deceive"), 4, "kept", "Deceives", "helps"),
        (promise_with(0.9, 0.6, 0.2, 0.4, "deceive"), 36, "cannot_tell", "Does not deceive", "does_not_help"),
    ],
)
def test_terminal_and_page_begin_with_what_the_patch_is_worth(promise, recognized, verdict, headline, word):
    summary, headline = summary_of(recognized, 40, promise), f"{headline} (controls simulated)"
    report = some_report().changed(summary=summary, controls=())
    assert (summary.verdict, headline_of(summary.model_dump()), summary.worth.word) == (verdict, headline, word)
    first, second = verdict_lines(report)[:2]
    assert first.startswith(f"{headline}. Recognized in {recognized / 40:.1%} [") and ", the bare object in " in first
    assert second.startswith(f"verdict: {verdict} (no control photographs). ")
    assert ("A gain of 10 points or more is ruled out." in first) == (word == "does_not_help")
    manifest = {"promise": promise.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    page = report_html(report.model_dump(mode="json"), manifest | {"design": None}, {})
    assert f'<h1 class="{word}">{headline}</h1>' in page and page.index(headline) < page.index("Promise ")
    assert re.search(r"\.helps\b[^{]*\{ color:var\(--yes\)", page) and f'<b class="{verdict}">Promise ' in page


def beside(name, recognized, half=0.2, n=40):
    """A control photographed as often as a patch of which 20 of 40 are recognized."""
    gain = 0.5 - recognized / n
    ends, known = (gain - half, gain + half), {"difference": gain, "difference_interval": (gain - half, gain + half)}
    return Control(name, recognized, n, (0, 1), rates=(0.5, recognized / n), patch_interval=(0.3, 0.7), sessions=4,
                   shown=ends[0] > 0, **known)  # fmt: skip


def test_the_strongest_evidence_decides_alone_and_is_named():
    """Photographed controls, else those rendered into the photographs with the promise's bare object, else its own."""
    rendered = EffectEstimate(photos=40, agree=0.9, controls=(beside("mean", 14, n=36), beside("gray", 4, n=36)))

    def worth(controls, promise, estimate=None):
        return benefit_of(40, 0.5, (0.35, 0.65), controls, promise, estimate)

    photographed = worth([beside("gray", 22), beside("bare", 18)], HELPFUL, rendered)
    assert (photographed.control, photographed.word, photographed.source) == ("gray", "cannot_tell", "photographed")
    assert worth([beside("bare", 4)], HARMFUL, rendered).word == "helps"
    unjudged = [Control("bare", 0, 0, (0, 1))]
    low = promise_with(0.9, 0.1, 0.7, 0.9)  # whose bare object the patch beats, so that the rendered mean decides
    told = worth(unjudged, low, rendered)
    assert (told.control, told.word, told.source, told.photos) == ("mean", "cannot_tell", "rendered", 36)
    assert worth(unjudged, HARMFUL, rendered).source == "simulated"  # the bare object, which the paper hides
    assert worth(unjudged, low, EffectEstimate(photos=40, agree=0.5)).source == "simulated"
    assert worth((), promise_of(0.9).changed(controls={})) is None


@pytest.mark.parametrize(("ends", "word"), [
    ((-0.1, 0.099), "does_not_help"), ((-0.1, 0.1), "cannot_tell"), ((0.0, 0.3), "cannot_tell"), ((0.01, 0.3), "helps"),
    ((0.01, 0.09), "does_not_help"), ((-1, 1), "cannot_tell"),
])  # fmt: skip
def test_an_interval_that_holds_none_and_a_gain_worth_having_cannot_tell(ends, word):
    assert Goal.assist.answer(ends) == Goal.deceive.answer((-ends[1], -ends[0])) == word
    control = replace(beside("bare", 20), difference_interval=ends)
    summary = some_report().summary.changed(verdict="kept", worth=benefit_of(40, 0.5, (0.3, 0.7), [control], HELPFUL))
    assert summary.worth.word == word and summary.meets("helps") == (word == "helps")
    assert headline_of(summary.model_dump()).endswith(" (controls photographed)")


def draft_promises(gain: float, count: int = 20):
    """Promises as drafts make them: 10 sessions of 4 views at rates that differ (correlation 0.1), controls in 2."""
    rng = np.random.default_rng(7)

    def hits(rate):
        return rng.random((10, 4)) < rng.beta(9 * rate, 9 * (1 - rate), (10, 1))

    for _ in range(count):
        design, controls = hits(0.35 + gain), {name: hits(0.35) for name in ("bare", "mean", "gray", "noise")}
        claims = {}
        for name, control in controls.items():
            difference, ends = session_difference(design[:, :2].ravel(), control[:, :2].ravel(), 2)
            claims[name] = (float(design[:, :2].mean()) - difference, *ends)
        yield promise_beside(float(design.mean()), claims)


def test_of_twenty_drafts_that_help_none_is_called_useless_and_of_useless_ones_at_most_one_helpful():
    said = {gain: Counter(each.answer for each in draft_promises(gain)) for gain in (0.0, 0.2, 0.5)}
    assert said[0.2]["does_not_help"] == said[0.5]["does_not_help"] == 0 and said[0.0]["helps"] <= 1
    assert said[0.5]["helps"] >= 8 and said[0.0]["cannot_tell"] >= 10  # as far as few views can tell


def test_who_cannot_tell_is_told_how_many_photographs_the_plan_asks_for():
    promise = promise_of(0.85, 0.2, correlation=0.1)
    needed, each = sessions_needed(promise), PHOTOS_PER_SESSION

    def needs(photos, verdict="cannot_tell", without=0, worth=None, promise=promise):
        return still_needed(promise, photos, without, verdict, worth)

    assert needed and f"{each} photographs in each of {needed} places" in needs((6,))
    assert f"So far: 6 of {each * needed}, in 1 place of {needed}." in needs((6,))
    assert needs(()) == photos_line(promise) and "So far" not in photos_line(promise)
    assert "new" in needs((each,) * needed) and "So far" not in needs((each,) * needed)
    assert "gains more" in needs((40,), promise=promise_of(0.3, 0.28, correlation=0.2))
    assert "markers" in needs((20,), without=3) and "markers" not in needs((20,), without=2)
    worth = benefit_of(40, 0.5, (0.3, 0.7), [beside("gray", 18)], HELPFUL)
    assert needs((40,), "kept") == needs((40,), "kept", worth=worth.changed(word="does_not_help")) == ""
    both = needs((6,), "kept", worth=worth)
    printed = f"{each} of its gray control (patchproof sheet RUN --control gray)"
    assert f"{printed} in each of {sessions_to_show(promise)} places" in both
    small = promise_of(0.9, 0.6, correlation=0.1)
    alone, shown = sessions_needed(small), sessions_to_show(small)
    assert alone < shown and photos_line(small, (), "gray").endswith(f"The promise alone is proved in {alone} places.")
    lost = needs((6,), worth=worth, promise=USELESS)  # one sentence, and no "take more" beside it
    assert lost == "Even 150 photographs are unlikely to show that it helps: make a design that gains more."
    draft = promise_beside(0.4, {"bare": (0.38, -0.2, 0.24)}).changed(draft=True)
    assert "promise it again first (patchproof promise RUN), or" in needs((6,), worth=worth, promise=draft)
    report = some_report().changed(summary=some_report().summary.changed(next_step="Take 10."))
    assert "Take 10." in verdict_lines(report)


def test_a_promise_that_asks_for_nothing_says_so():
    assert "asks for nothing: any photographs keep it" in judge(0, (10,) * 4, USELESS).reason
    assert "asks for nothing" not in judge(36, (10,) * 4, HELPFUL).reason
    never = promise_with(0.97, 1.0, -0.09, 0.0, "deceive")
    assert "asks for nothing" in judge(40, (10,) * 4, never).reason


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

    assert said({}) == "in synthetic rooms" and said({"images": "a/yards"}) == "before pictures (yards)"
    assert said({"color": (0.5, 0.5, 0.5)}).startswith("before ONE PLAIN COLOR")
    assert (
        background_summary({"object": {"photos": "x"}}) == "in the scene's own pictures"
        and background_summary({}) == ""
    )
    plain = said({"color": (0.5, 0.5, 0.5)})
    report = some_report().changed(summary=some_report().summary.changed(background=plain))
    assert any("ONE PLAIN COLOR" in line for line in verdict_lines(report))
    assert any(
        "ONE PLAIN COLOR" in line for line in promise_lines(HELPFUL, scene | {"background": {"color": (0.5, 0.5, 0.5)}})
    )
    manifest = {"promise": HELPFUL.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    assert "ONE PLAIN COLOR" in report_html(report.model_dump(mode="json"), manifest | {"design": None}, {})


@pytest.mark.parametrize("views", [0, 48])
def test_that_the_promise_is_a_draft_is_said(views):
    summary = some_report().summary.changed(background="in synthetic rooms", draft_views=views)
    report = some_report().changed(summary=summary)
    promise = HELPFUL.changed(draft=views > 0)
    manifest = {"promise": promise.model_dump(mode="json"), "settings": {}, "kind": "design", "page_mm": (210, 297)}
    page = report_html(report.model_dump(mode="json"), manifest | {"design": None}, {})
    assert ("The promise is a draft of 48 views (preliminary)." in page) == (views > 0)
    line = "promise simulated in synthetic rooms"
    hint = f"{line}; a draft of 48 views, preliminary"
    assert (hint if views else line) in verdict_lines(report)
