"""What the notebook says of hardened pictures and of the paper's experiments, held against the stored figures."""

from __future__ import annotations

import csv
import json
from importlib import import_module
from pathlib import Path

import pytest

from patchproof.claims import wilson
from patchproof.strict import read_toml, validated
from patchproof.study.study import STUDIES

NOTES = Path(__file__).resolve().parents[1] / ".readme"
PAGE = " ".join((NOTES / "measured.md").read_text(encoding="utf-8").split())
THROUGH = "through the attack, 100 steps of ε/10 from a random start"
SURVIVAL = {
    "an attack of one step": ("settings", "1 steps"),
    "of five": ("settings", "5 steps"),
    "of ten": ("settings", "10 steps"),
    "ε = 0.01 after normalization": ("settings", "ε in normalized units"),
    "made on the original, added to the hardened": ("settings", "made on the original, added to the hardened"),
    "hardened after the attack": ("settings", "hardened after the attack"),
    "hardened within 0.1, attacked by 0.005": ("reach", "0.1 at 0.005"),
    "hardened within 0.1": ("reach", "0.1 at 0.01"),
    "hardened within 0.04, through the attack": ("reach", "0.04 through at 0.01"),
    "hardened within 0.1, through the attack": ("reach", "0.1 through at 0.01"),
    "likewise, 100 steps from a random start": ("settings", f"0.1 {THROUGH}, cross-entropy"),
    "likewise, along the margin": ("settings", f"0.1 {THROUGH}, margin loss"),
}


def survived(found: dict, table: str, key: str) -> tuple[int, int]:
    hits = found[table][key]["hits"]
    return hits.count("1"), len(hits)


def in_words(count: int, n: int) -> str:
    low, high = wilson(count, n)
    return f"{count}, {100 * count / n:.0f} % [{100 * low:.0f}, {100 * high:.0f}]"


def row_of(words: str) -> str:
    both = [json.loads((NOTES / f"pgd/{name}.json").read_text("utf-8")) for name in ("mobilenet", "builtin")]
    return f"| {words} | " + " | ".join(in_words(*survived(found, *SURVIVAL[words])) for found in both) + " |"


@pytest.mark.parametrize("words", SURVIVAL)
def test_survivors_are_the_stored_ones(words):
    assert row_of(words) in PAGE


def test_what_is_ruled_out_left_nothing():
    found = json.loads((NOTES / "pgd/mobilenet.json").read_text("utf-8"))
    for key in ("steps of ε", "steps of ε/20", "a random start", "plain float32 gradient", "softmax taken twice"):
        assert survived(found, "settings", key) == (0, 23), key
    assert found["zero gradients"] == 0


def test_stress_is_the_stored_one():
    with (NOTES / "paper/stress_worst.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        if row["test"] in ("worst pose", "black square"):
            there, usual = (f"{100 * float(row[key]):.0f}" for key in ("rate", "rate anywhere"))
            assert f"{there} % (elsewhere {usual})" in PAGE


@pytest.mark.parametrize("name", ["stress", "robust", "patch2d"])
def test_configs_are_read(name):
    study = import_module(STUDIES[name]).STUDY
    assert validated(study.settings, read_toml(NOTES / f"paper/{name}.toml"), name)
