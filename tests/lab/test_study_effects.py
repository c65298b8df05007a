"""Estimated effects against photographs: the tables by hand, and one cell from scene to table."""

from pathlib import Path

import pytest

from patchlab.study.study import Cell, Result
from patchlab.validation import effects, photo_sessions
from test_study_promises import small_study

SETTINGS = effects.EffectsSettings(scenes=("a",), networks=("builtin",))


def result(scene, *sessions):
    values = {"name": scene, "scene": scene, "network": "builtin", "seed": 0}
    return Result(Cell(f"{scene}{len(sessions)}", values), {"sessions": list(sessions)}, Path())


def session(estimated=None, photographed=None):
    return {"photos": 20, "agree": 0.9, "estimated": estimated and [estimated], "photographed": photographed}


def test_effects_by_hand():
    kept, lost = session((0.3, 0.1, 0.5), 0.4), session((0.3, 0.1, 0.5), 0.6)
    of_scenes, each = effects.tables(SETTINGS, [result("a", kept, lost, session(None, 0.2))])
    name, count, refused, photographed, error, held = of_scenes.rows[0]
    assert (name, count) == ("a", 3) and refused.value == pytest.approx(1 / 3)  # one refused
    assert photographed.value == pytest.approx(0.5) and error.value == pytest.approx(-0.2) and held.value == 0.5
    assert of_scenes.rows[0][1:] == of_scenes.rows[-1][1:]
    assert len(each.rows) == 3 and {len(row) for row in each.rows} == {len(each.head)}


def test_nothing_to_estimate_is_no_figure():
    (row, _), _ = (table.rows for table in effects.tables(SETTINGS, [result("a", session())]))
    assert row[3:] == (None, None, None)


def test_a_cell_goes_from_the_scene_to_effects(tmp_path, monkeypatch):
    (one,) = small_study("effects", tmp_path, monkeypatch, 1).results
    (session,) = one.answers["sessions"]
    assert session["photographed"] is not None and 0 < session["photos"] <= 5
    assert session["agree"] is None or 0 <= session["agree"] <= 1


@pytest.mark.parametrize("sessions", [[""], ["session_1", "session_2"]])
def test_photographs_of_each_session_are_verified_beside_those_of_the_control(sessions, tmp_path, monkeypatch):
    """One session's photographs lie in the folder itself, in no folder of a session."""
    verified = []
    folders = {None: tmp_path / "photos", "gray": tmp_path / "gray"}
    for folder in folders.values():
        for name in sessions:
            (folder / name).mkdir(parents=True)
            (folder / name / "photo_0001.jpg").write_bytes(b"")
    monkeypatch.setattr(photo_sessions, "make_run_and_sheet", lambda base, cell, folder: None)
    monkeypatch.setattr(
        photo_sessions, "take_photos", lambda settings, cell, run, folder, control=None: folders[control]
    )
    monkeypatch.setattr(
        photo_sessions, "verify_photos", lambda photos, *rest, controls: verified.append((photos, controls))
    )
    monkeypatch.setattr(effects, "_record_session", lambda report, control: session())
    monkeypatch.setattr(photo_sessions, "record_promise", lambda run: {})
    answers = effects.run(SETTINGS, tmp_path, Cell("a", {}))
    assert verified == [(folders[None] / name, folders["gray"] / name) for name in sessions]
    assert len(answers["sessions"]) == len(sessions)
