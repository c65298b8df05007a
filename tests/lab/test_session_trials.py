"""The study of trials by sessions: a trial of each kind, and its tables."""

import csv
from pathlib import Path

import numpy as np

from patchlab.study.study import Cell, Result
from patchlab.validation import session_trials

SETTINGS = session_trials.SessionTrialsSettings(deals=2)


def test_folders_of_dealt_sessions_are_merged_and_true_ones_are_not():
    rng = np.random.default_rng(0)
    trials, *kept, found = session_trials._folder_trials(SETTINGS, 0.1, "runs of 3", True, rng)
    assert trials == 2 and all(0 <= count <= 2 for count in kept) and found <= 4
    assert session_trials._folder_trials(SETTINGS, 0.1, "true", False, rng)[-1] > 5


def test_controls_are_counted_and_tables_show_shares():
    trials = session_trials._control_trials(6, 0.0, 4, 0.95, 0.05, "pairs", np.random.default_rng(0))
    assert trials == (6, 6, 6)
    answers = {"controls": [[4, 0.95, 0.05, "pairs", *trials]], "folders": [["true", True, 2, 1, 1, 0, 6.0]]}
    result = Result(Cell("a", {"correlation": 0.1}), answers | {"looks": [["one look", 200, 4, 4]]}, Path())
    controls, folders, looks = (table.rows[0] for table in session_trials.tables(SETTINGS, [result]))
    assert controls[:5] == (0.1, 4, 0.95, 0.05, "pairs") and controls[5].value == 1
    assert folders[:3] == (0.1, "true", "yes") and folders[3].value == 0.5 and folders[-1] == 6
    assert looks[2].value == 0.02 and looks[2].n == 200


def test_what_dealt_folders_prove_in_the_notebook_is_what_is_stored():
    results = Path(session_trials.__file__).parents[1] / "results"
    page = " ".join((results / "measured.md").read_text("utf-8").split())
    rows = list(csv.DictReader((results / "sessions/session-trials_folders.csv").read_text("utf-8").splitlines()))
    dealt = [row for row in rows if row["dealt"] != "true"]

    def kept(name):
        of_each = ([row for row in dealt if row["correlation"] == rho] for rho in ("0.0", "0.1", "0.2", "0.3"))
        return " / ".join(str(round(sum(100 * float(row[name]) for row in rows))) for rows in of_each)

    assert f"{kept('kept')} of 600 ({kept('kept as dealt')})" in page
    found = [
        np.mean([float(row["sessions found"]) for row in rows if (row["dealt"], row["times"]) == (how, "no")])
        for how in ("true", "one each", "runs of 3")
    ]
    assert (
        "found as {:.2f}, three that are dealt into 60 and 20 folders without times as {:.1f} and {:.1f}".format(*found)
        in page
    )


def test_what_looks_and_controls_prove_in_the_notebook_is_what_is_stored():
    results = Path(session_trials.__file__).parents[1] / "results"
    page = " ".join((results / "measured.md").read_text("utf-8").split())
    of = {
        name: list(csv.DictReader((results / f"sessions/session-trials_{name}.csv").read_text("utf-8").splitlines()))
        for name in ("looks", "controls")
    }
    for looks in ("each session", "watched"):
        rows = [row for row in of["looks"] if row["looks"] == looks]
        with_limit, without = (
            " / ".join(f"{1600 * float(row[name]):.0f}" for row in rows) for name in ("kept", "without a limit")
        )
        assert f"{with_limit} of 1600 ({without})" in page
    equal = [row for row in of["controls"] if row["patch"] == row["control"]]
    by_rho = {rho: [row for row in equal if row["correlation"] == rho] for rho in ("0.0", "0.1", "0.2", "0.3")}
    shares, by_photos = (
        " / ".join(f"{100 * np.mean([float(row[name]) for row in rows]):.1f}".lstrip("0") for rows in by_rho.values())
        for name in ("called better", "by photographs")
    )
    worst = " / ".join(f"{100 * max(float(row['called better']) for row in rows):.1f}" for rows in by_rho.values())
    assert f"| {shares} % ({by_photos} %); the worst kind {worst} % |" in page
