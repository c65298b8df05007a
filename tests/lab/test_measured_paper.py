"""What the notebook says of hardened pictures and of the paper's experiments, held against the stored figures."""

from __future__ import annotations

import csv
from importlib import import_module
from pathlib import Path

import pytest

from patchlab.study.study import STUDIES
from patchproof.base.validation import read_toml, validate_model

NOTES = Path(__file__).resolve().parents[2] / "src/patchlab/results"
PAGE = " ".join((NOTES / "measured.md").read_text(encoding="utf-8").split())


def test_hardening_through_the_attack_is_the_stored_one():
    with (NOTES / "pgd/through.csv").open(encoding="utf-8") as file:
        _, small, large = csv.DictReader(file)
    value, interval = percent(small, "hardened")
    assert f"{value} % {interval} of {small['hardened_n']} under PGD of 0.01" in PAGE
    assert float(small["original"]) == float(large["hardened"]) == 0


def test_stress_is_the_stored_one():
    for row in rows_of("stress_worst.csv"):
        if row["test"] in ("worst pose", "black square"):
            there, usual = (f"{100 * float(row[key]):.0f}" for key in ("rate", "rate anywhere"))
            assert f"{there} % (elsewhere {usual})" in PAGE


def rows_of(name: str) -> list[dict[str, str]]:
    with (NOTES / "paper" / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def percent(row: dict[str, str], key: str, sign: str = "") -> tuple[str, str]:
    value, low, high = (100 * float(row[key + end]) for end in ("", "_low", "_high"))
    return f"{value:{sign}.1f}", f"[{low:.1f}, {high:.1f}]"


def test_gain_and_harm_of_2d_patches_are_the_stored_ones():
    for row in rows_of("patch2d_pooled.csv"):
        cells = (" ".join(percent(row, f"patch minus {other}", "+")) for other in ("bare", "gray", "noise"))
        assert f"| {row['rate']} | {' | '.join(cells)} |" in PAGE
        assert row["patch minus bare_n"] == "6"
    assert {row["patch_n"] for row in rows_of("patch2d_harm.csv")} == {"24"}


def test_rates_of_robust_designs_are_the_stored_ones():
    rows = rows_of("robust_rates.csv")
    for scene, name in (("suv", "SUV"), ("carton", "carton"), ("postbox", "letter box")):
        cells = (" ".join(percent(row, "design")) for row in rows if row["scene"] == scene)
        assert f"| {name} | {' | '.join(cells)} |" in PAGE
    assert {percent(row, "gray") for row in rows} == {("0.0", "[0.0, 6.0]")}


def test_rates_of_the_car_are_the_stored_ones():
    by_way = {(row["way"], row["trained on"] == "original"): row for row in rows_of("masked_matrix.csv")}
    for key in by_way:
        value, interval = percent(by_way[key], "rate")
        assert f"{value} % {interval}" in PAGE, key
    value, interval = percent(by_way["small_steps", False], "gain in rate", "+")
    assert f"({value} points {interval})" in PAGE


@pytest.mark.parametrize(
    ("name", "config"), [(each, each) for each in ("stress", "robust", "patch2d")] + [("transfer", "masked")]
)
def test_configs_are_read(name, config):
    study = import_module(STUDIES[name]).STUDY
    assert validate_model(study.settings, read_toml(NOTES / f"paper/{config}.toml"), name)
