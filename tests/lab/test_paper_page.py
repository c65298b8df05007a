"""The page of the paper's tables: rows, verdicts, configs of every part, and the printing of patches."""

from __future__ import annotations

import json
from types import SimpleNamespace

import pytest

from patchlab import cli
from patchlab.paper import page, printed
from patchlab.study.study import Result, load_study
from patchlab.validation import photo_sessions
from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate
from patchproof.base.validation import read_toml, validate_model


def spec(**changed):
    return page.RowSpec(row="a row", **changed)


@pytest.mark.parametrize("form", ["", "quick"])
@pytest.mark.parametrize("part", page.PARTS)
def test_every_part_has_a_config_in_both_forms(part, form):
    settings = load_study(page.PARTS[part]).settings
    found = validate_model(settings, read_toml(page.CONFIGS / form / f"{part}.toml"), part)
    networks = getattr(found, "models", None) or getattr(found, "networks", ())
    if not form and part != "printed":
        assert len(networks) >= (6 if part in ("hardened", "budget") else 4)
        assert len(getattr(found, "seeds", (0, 1))) >= 2 and len(getattr(found, "scenes", None) or found.__dict__) >= 3


def test_rows_name_tables_of_parts_and_are_not_run_or_told_why(tmp_path):
    specs = page.page_specs()
    assert all(row.table.partition("/")[0] in page.PARTS for each in specs for row in each.rows if not row.because)
    tables = page.page_tables(tmp_path)
    assert sum(len(table.rows) for table in tables) > 150
    for row in (row for table in tables for row in table.rows):
        assert row[2] is None and (row[3] == "not run yet" or row[3].startswith("cannot be told, because"))
    words = " ".join(row[0] for table in tables for row in table.rows)
    for word in (
        "VGG-16 BN",
        "ShuffleNet v2",
        "pgd 0.04, original",
        "tram",
        "Inception v3",
        "black square",
        "M_2_bound",
    ):
        assert word in words


def test_verdicts_are_those_of_intervals():
    ours = Estimate(0.5, 0.4, 0.6, 9)
    for (low, high), said in {
        (0.6, 0.9): "agrees",
        (0.61, 0.9): "does not, ours is lower",
        (0.1, 0.39): "does not, ours is higher",
    }.items():
        assert page.verdict(spec(range=(low, high)), ours) == said
    assert page.verdict(spec(claim="above"), ours) == "agrees in sign"
    assert page.verdict(spec(claim="below"), ours) == "does not, ours is higher"
    assert page.verdict(spec(claim="below"), Estimate(0.1, -0.1, 0.3, 9)).endswith("the interval holds 0")
    assert page.verdict(spec(range=(0, 1)), 0.5).startswith("cannot be told, because too few")
    assert page.verdict(spec(), ours).endswith("the paper has no figure")
    assert page.verdict(spec(), None, was_run=True) == "cannot be told, because the study gave no such figure"
    assert page.verdict(spec(range=(0, 1), because="no mesh"), None) == "cannot be told, because no mesh"


def test_figures_come_from_stored_tables(tmp_path):
    (tmp_path / "stress").mkdir()
    lines = [f"net{i},0,black square,{-0.1 * i - 0.05 * seed},a" for i in range(1, 6) for seed in (0, 1)]
    text = "network,seed,test,difference,scene\n" + "\n".join([*lines, "net1,0,worst pose,9,a"]) + "\n"
    (tmp_path / "stress/stress_worst.csv").write_text(text)
    common = {"table": "stress/worst", "column": "difference", "by": ("scene", "network")}
    found = page.our_figure(tmp_path, spec(where={"test": "black square"}, **common))
    assert found.n == 5 and found.value == pytest.approx(-0.325) and found.high < 0
    assert page.our_figure(tmp_path, spec(where={"test": "worst pose"}, **common)) == 9
    minus = page.our_figure(tmp_path, spec(where={"test": "worst pose"}, minus={"test": "black square"}, **common))
    assert minus == pytest.approx(9.125)
    (tmp_path / "patches").mkdir()
    stored = "object,3d minus 2d,3d minus 2d_low,3d minus 2d_high,3d minus 2d_n\nsuv,0.2,0.1,0.3,800\n"
    (tmp_path / "patches/patch3d_meshes.csv").write_text(stored)
    row = spec(table="patches/meshes", where={"object": "suv"}, column="3d minus 2d")
    assert page.our_figure(tmp_path, row) == Estimate(0.2, 0.1, 0.3, 800)
    page.write_paper_page(page.page_tables(tmp_path), tmp_path / "out", tmp_path)
    assert "not run yet" in (tmp_path / "out/paper.html").read_text() and (tmp_path / "out/paper_claims.csv").is_file()


def test_the_page_in_the_results_is_that_of_the_stored_tables():
    text = (page.CONFIGS.parent / "paper.md").read_text(encoding="utf-8")
    assert text == page.as_markdown(page.page_tables(page.STORED)), "patchlab table paper > .../results/paper.md"


def test_the_command_prints_the_page_and_runs_its_parts(tmp_path, capsys, monkeypatch):
    runs = []

    def run_study(name, config, out, work, changed):
        runs.append((name, config.name, config.parent.name, out.name, changed, work.resume))
        return SimpleNamespace(failed={"cell": "broke"} if name == "stress" else {})

    monkeypatch.setattr(page, "run_study", run_study)
    arguments = ["table", "paper", "--run", str(tmp_path), "--part", "stress,printed", "--quick"]
    with pytest.raises(SystemExit) as left:
        cli.app(arguments)
    said = capsys.readouterr().out
    assert left.value.code == 1 and "failed: stress cell: broke" in said and "| VGG-16 BN |" in said
    changed = {"patches": str(tmp_path / "patches")}
    assert runs == [
        ("printed", "printed.toml", "quick", "printed", changed, True),
        ("stress", "stress.toml", "quick", "stress", {}, True),
    ]
    with pytest.raises(Refused, match='"patch": did you mean "patches"'):
        page.run_parts(tmp_path, ["patch"])
    page.run_parts(tmp_path, ["hardened"], photos=tmp_path)
    assert runs[-1][4] == {"images": str(tmp_path), "labels": str(tmp_path / "labels.csv")}


def test_photographs_of_packages_are_used_where_they_are(tmp_path, monkeypatch):
    package = tmp_path / "package"
    (package / "data").mkdir(parents=True)
    (package / "data/coffee.png").write_bytes(b"picture")
    place = SimpleNamespace(submodule_search_locations=[str(package)])
    monkeypatch.setattr(page, "find_spec", lambda name: place if name == "skimage" else None)
    folder = page.write_photos(tmp_path / "photos", quick=False)
    assert (folder / "labels.csv").read_text() == "file,label\ncoffee.png,967\n"
    monkeypatch.setattr(page, "find_spec", lambda name: None)
    with pytest.raises(Refused, match="--photos DIR"):
        page.write_photos(tmp_path / "none", quick=False)


def patches_folder(tmp_path):
    """A finished study of patches with one cell on each of two scenes."""
    hits = {"bare": ["0000"], "2d": ["0100"], "3d": ["1110"]}
    cells = {
        f"{name}.net.0": {"cell": {"name": name, "network": "net", "seed": 0}, "found": {"hits": hits}}
        for name in ("suv", "carton")
    }
    folder = tmp_path / "patches"
    (folder / "files").mkdir(parents=True)
    (folder / "patch3d.json").write_text(json.dumps({"cells": cells}))
    for name in cells:
        for kind in printed.KINDS:
            (folder / f"files/{name}-{kind}.png").write_bytes(kind.encode())
    return folder


def test_patches_to_print_are_those_of_a_finished_study(tmp_path):
    folder = patches_folder(tmp_path)
    settings = printed.PrintedSettings(patches="patches", scenes=("suv",))
    (cell,) = printed.cells(settings, tmp_path)
    assert cell.values["digital"] == {"bare": 0, "2d": 0.25, "3d": 0.75}
    (folder / "files/suv.net.0-2d.png").write_bytes(b"another design")
    assert printed.cells(settings, tmp_path)[0].values != cell.values  # is printed again
    (folder / "patch3d.json").write_text('{"settings": {}}')
    with pytest.raises(Refused, match="a finished study patch3d"):
        printed.cells(settings, tmp_path)


def test_both_designs_are_printed_and_the_bare_object_photographed_once(tmp_path, monkeypatch):
    patches_folder(tmp_path)
    settings = printed.PrintedSettings(patches="patches", scenes=("suv",))
    (cell,) = printed.cells(settings, tmp_path)
    pictures, photographed = [], []

    def make(base, cell, folder, views):
        pictures.append((cell.values["picture"], views))

    def take(settings, cell, run, folder, control=None):
        photographed.append((folder.name, control))
        return folder / (control or "photos")

    def verify(photos, folder, base, cell, ledger_photos, controls):
        share = SimpleNamespace(share=0.1)
        ledger = None if folder.name == "2d" else SimpleNamespace(ideal=0.9, shares={"print": share})
        summary = SimpleNamespace(sessions=[SimpleNamespace(recognized=3, judged=5)] * 2, ledger=ledger)
        control = SimpleNamespace(recognized=1, n=10)
        return SimpleNamespace(summary=summary, controls=[control])

    for name, fake in {"make_run_and_sheet": make, "take_photos": take, "verify_photos": verify}.items():
        monkeypatch.setattr(photo_sessions, name, fake)
    answers = printed.run(settings, tmp_path, cell)
    assert pictures == [(f"patches/files/suv.net.0-{kind}.png", 64) for kind in ("3d", "2d")]
    assert photographed == [("3d", None), ("3d", "bare"), ("2d", None)]
    gains, steps = printed.tables(settings, [Result(cell, answers, tmp_path)])
    assert gains.rows[0] == ("3d minus bare", 0.75, pytest.approx(0.5), pytest.approx(0.25), 1)
    assert gains.rows[2][1:4] == (0.5, 0, 0.5) and steps.rows == (("3d", "print", 0.1, 1),)
