"""The study of the gap ledger: what its tables count, and that its troubles are what they say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from patchlab.study.study import Result, load_study
from patchlab.validation import ledger_trials
from patchproof.base.color import linear_from_srgb
from patchproof.channel.printer import identity_printer

SETTINGS = ledger_trials.LedgerSettings(runs=("a/run", "b/run"), trials=10)


def found(outcome="asked", named=None):
    told = {"trouble": "x", "outcome": outcome, "cost": 0.2, "photos": 6}
    return told if outcome != "asked" else told | {"named": named, "shares": {"print": 0.2}, "sum_error": 1e-16}


def test_trials_take_turns_of_culprits_and_runs():
    cells = ledger_trials.cells(SETTINGS, Path())
    assert [c.values["culprit"] for c in cells[:5]] == ["print", "blur", "cast", "dim", "print"]
    assert [c.values["run"] for c in cells] == ["a/run"] * 4 + ["b/run"] * 4 + ["a/run"] * 2
    assert load_study("ledger") is ledger_trials.STUDY


def test_only_troubles_that_cost_something_are_counted():
    said = ["print", "blur_and_noise", "print", "light_and_camera", None]  # the cast was taken for print
    told = [found(named=name) for name in said[:4]] + [found(named=None), found("weak"), found("unreadable")]
    results = [
        Result(cell, one, Path()) for cell, one in zip(ledger_trials.cells(SETTINGS, Path()), told, strict=False)
    ]
    rates, confusions, trials = ledger_trials.tables(SETTINGS, results)
    rows = {row[0]: row[1:] for row in rates.rows}
    assert (rows["all"][0].value, rows["all"][0].n) == (3 / 5, 5) and rows["all"][1:] == (1, 1)
    assert (rows["print"][0].value, rows["print"][0].n) == (1 / 2, 2)
    assert rows["blur"][1:] == (1, 0) and rows["cast"][1:] == (0, 1)
    table = {row[0]: dict(zip(confusions.head[1:], row[1:], strict=True)) for row in confusions.rows}
    assert table["cast"]["print"] == 1 and table["print"]["none"] == 1 and table["dim"]["light_and_camera"] == 1
    assert len(trials.rows) == 7


def test_faded_dyes_keep_their_share_of_density_and_black_stays():
    srgb = np.array([[[0.9, 0.5, 0.5], [0.0, 0.0, 0.0], [0.4, 0.4, 0.4]]])
    before = linear_from_srgb(identity_printer().apply(as_tensor(srgb))[0].permute(1, 2, 0).numpy())
    after = ledger_trials._faded_light(identity_printer(), np.full(3, 0.5), srgb)
    assert after[0, 1:] == pytest.approx(np.maximum(before[0, 1:], 1e-3), rel=1e-3)
    ratio = np.log(after[0, 0, 0] / after[0, 0, 1]) / np.log(before[0, 0, 0] / before[0, 0, 1])
    assert ratio == pytest.approx(0.5, rel=1e-3)


def as_tensor(srgb):
    import torch

    return torch.from_numpy(srgb).float().permute(2, 0, 1)[None]
