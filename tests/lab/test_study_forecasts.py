"""Forecasts and effects against photographs: the tables by hand, and one cell from scene to table."""

from pathlib import Path

import pytest

from patchlab.study.study import Cell, Result
from patchlab.validation import forecasts, photo_sessions
from test_study_promises import small_study

SETTINGS = forecasts.ForecastsSettings(scenes=("a",), networks=("builtin",))


def result(scene, *sessions, hits=320, n=400):
    values = {"name": scene, "network": "builtin", "seed": 0}
    answers = {"promised": "1" * hits + "0" * (n - hits), "per_session": 1, "places": [], "sessions": list(sessions)}
    return Result(Cell(f"{scene}{len(sessions)}", values), answers, Path())


def session(pairs, estimated=None, photographed=None):
    return {"forecast": pairs, "agree": 0.9, "estimated": estimated and [estimated], "photographed": photographed}


def test_scores_widths_and_effects_by_hand():
    sure = [(0.95, True)] * 10 + [(0.05, False)] * 10
    kept = session(sure, (0.3, 0.1, 0.5), 0.4)
    lost = session(sure, (0.3, 0.1, 0.5), 0.6)
    of_photos, effects, each = forecasts.tables(SETTINGS, [result("a", kept, lost, session([], None, 0.2))])
    name, n, brier, promise, slope, held, width, promised_width, promised_held = of_photos.rows[0]
    assert (name, n, brier) == ("a", 40, pytest.approx(0.0025)) and promise == pytest.approx((0.04 + 0.64) / 2)
    assert slope > 1 and held.value == 1 and promised_held.value == 0  # 10 of 20 where 80 % are promised
    assert 0 < width < promised_width
    assert effects.rows[0][1] == 3 and effects.rows[0][2].value == pytest.approx(1 / 3)  # one refused
    assert effects.rows[0][3].value == pytest.approx(0.5) and effects.rows[0][4].value == pytest.approx(-0.2)
    assert effects.rows[0][5].value == 0.5 and len(each.rows) == 3
    assert of_photos.rows[0][1:] == of_photos.rows[-1][1:]


def test_nothing_to_forecast_is_no_figure():
    (row, _), effects, _ = (table.rows for table in forecasts.tables(SETTINGS, [result("a", session([]))]))
    assert row == ("a", 0, *(None,) * 7) and effects[0][3:] == (None, None, None)
    assert forecasts.figures(SETTINGS, [result("a", session([]))]) == ()
    assert len(forecasts.figures(SETTINGS, [result("a", session([(0.9, True)]))])) == 1


def test_a_cell_goes_from_the_scene_to_forecasts_and_effects(tmp_path, monkeypatch):
    (one,) = small_study("forecasts", tmp_path, monkeypatch, 2).results
    assert len(one.answers["sessions"]) == 2
    for session in one.answers["sessions"]:
        # a photograph or two may be too small to be taken again
        assert 3 <= len(session["forecast"]) <= 5 and all(0 < chance < 1 for chance, _ in session["forecast"])
        assert session["photographed"] is not None and (session["agree"] is None) == (len(session["forecast"]) < 5)


def test_photographs_of_one_session_are_verified_too(tmp_path, monkeypatch):
    """One session's photographs lie in the folder itself, in no folder of a session."""
    verified = []
    folders = {None: tmp_path / "photos", "gray": tmp_path / "gray"}
    for folder in folders.values():
        folder.mkdir()
        (folder / "photo_0001.jpg").write_bytes(b"")
    monkeypatch.setattr(photo_sessions, "make_run_and_sheet", lambda base, cell, folder: None)
    monkeypatch.setattr(
        photo_sessions, "take_photos", lambda settings, cell, run, folder, control=None: folders[control]
    )
    monkeypatch.setattr("patchproof.reprints.photo_forecast.photo_forecaster", lambda run, manifest: None)
    monkeypatch.setattr("patchproof.sheets.manifest.load_manifest", lambda path: None)
    monkeypatch.setattr(
        photo_sessions, "verify_photos", lambda photos, *rest, controls: verified.append((photos, controls))
    )
    monkeypatch.setattr(forecasts, "_record_session", lambda report, control: session([]))
    monkeypatch.setattr(photo_sessions, "record_promise", lambda run: {})
    answers = forecasts.run(SETTINGS, tmp_path, Cell("a", {}))
    assert len(answers["sessions"]) == 1 and verified == [(folders[None], folders["gray"])]
