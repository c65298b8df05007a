"""The README's own blocks, run as they stand, and figures in prose held against stored ones."""

from __future__ import annotations

import csv
import json
import re
import shlex
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from console import command
from PIL import Image
from test_imports import MAY_IMPORT

from patchlab.study.record import parse_hits
from patchlab.study.study import load_study
from patchproof.base.fingerprint import value_sha256
from patchproof.base.intervals import student_mean, wilson
from patchproof.base.settings import SceneSettings
from patchproof.base.validation import read_toml, validate_model
from patchproof.optimizer.run import load_run
from patchproof.scene.scene import load_scene

ROOT = Path(__file__).resolve().parents[1]
README, NOTEBOOK, CONTRIBUTING = (
    ROOT / "README.md",
    ROOT / "src" / "patchlab" / "results" / "measured.md",
    ROOT / ".github" / "CONTRIBUTING.md",
)
PACKAGE = ROOT / "src" / "patchproof"
PRINTERS = ("coated", "office", "uncoated")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)


@pytest.fixture(autouse=True)
def few_views(monkeypatch):
    """Of a promise and of the selection set, and no chances of numbers to advise: what they cost is time."""
    monkeypatch.setattr("patchproof.evidence.verdict.kept_chance", lambda *_: 0.9)
    monkeypatch.setattr("patchproof.optimizer.run.PROMISE_VIEWS", 16)
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 4)


@pytest.fixture(scope="module")
def here(tmp_path_factory):
    folder = tmp_path_factory.mktemp("readme")
    toml = blocks("toml")[0]
    # fewer steps and smaller photographs than a user would take, before gray
    (folder / "scene.toml").write_text(
        toml
        + "\n[optimize]\nsteps = 3\nviews = 2\n[camera]\nphoto_px = [800, 600]\n"
        + "[background]\ncolor = [0.5, 0.5, 0.5]\n",
        encoding="utf-8",
    )
    return folder


def test_commands(here, monkeypatch, capsys):
    monkeypatch.chdir(here)
    # fewer than a user would ask for
    lines = re.sub(r"--n \d+ --sessions \d+", "--n 1 --sessions 1", blocks("console")[0]).replace("--n 100", "--n 4")
    for line in lines.splitlines():
        program, *arguments = shlex.split(line)
        assert program == "patchproof"
        assert command(*arguments) == 0, capsys.readouterr().err
    # something to gain: what a full optimization gains stands in the prose and the notebook
    assert load_run("run").promise.controls["bare"].rate < 0.6
    said = r"`helps: (\+[\d.]+ points \[\+[\d.]+, \+[\d.]+\]) beside its best control \((\w+)\)"
    gain = re.search(said, README.read_text("utf-8"))
    (row,) = (line for line in NOTEBOOK.read_text("utf-8").splitlines() if line.startswith("| README's scene"))
    assert gain and f"{gain[2]} " in row and gain[1] in row


def test_every_scene_is_one_and_every_option_exists(capsys):
    for toml in blocks("toml"):
        validate_model(SceneSettings, tomllib.loads(toml), "README.md")
    for line in "".join(blocks("console")).splitlines():
        _, *arguments = shlex.split(line)
        command(*arguments[: 2 if arguments[0] in {"calibrate"} else 1], "--help")
        listed = capsys.readouterr().out
        assert all(option in listed for option in arguments if option.startswith("--")), line


@pytest.mark.parametrize(
    ("folder", "name", "count"),
    [
        ("promises", "promises", 6 * 2),
        ("ablation", "ablation", 4 * (1 + 11)),
        ("families", "transfer", 7 * (1 + 5 + 3)),
    ],
)
def test_the_studies_that_are_quoted_can_be_run_again(folder, name, count):
    study, path = load_study(name), README.parent / "src/patchlab/results" / folder / f"{name}.toml"
    settings = validate_model(study.settings, read_toml(path), name)
    assert len({cell.name for cell in study.cells(settings, path.parent)}) == count


def test_python(here, monkeypatch, capsys):
    (code,) = blocks("python")
    assert sum(bool(line.strip()) for line in code.splitlines()) <= 8
    monkeypatch.chdir(here)
    fewer = code.replace('"truck")', '"truck", draft=True)').replace("48,", "2,").replace("sessions=12", "sessions=2")
    assert len(fewer) == len(code) + len(", draft=True") - 2
    monkeypatch.setattr("patchproof.optimizer.run.DRAFT_EFFORT", (1, 8))
    exec(compile(fewer, "README.md", "exec"), {})
    assert capsys.readouterr().out.split()[0] in ("kept", "broken", "cannot_tell")


def words(path: Path) -> str:
    """A page in one line."""
    return " ".join(path.read_text(encoding="utf-8").split())


def stored(name: str) -> dict:
    return json.loads((NOTEBOOK.parent / name).read_text(encoding="utf-8"))


def check_picture(picture: str, figures: str):
    with Image.open(NOTEBOOK.parent / picture) as image:
        assert image.info["Comment"] == value_sha256(stored(figures)), "draw it again"


@pytest.mark.parametrize("name", ["journey", "report"])
def test_pictures_show_the_demo_of_today(name):
    """Each says in its comment which sheet it shows; an id follows from the scene and its seed."""
    with Image.open(ROOT / ".readme" / f"{name}.png") as image:
        remedy = "take it again from the demo, with its sheet's id as the PNG's comment"
        assert image.info["Comment"] == load_scene(PACKAGE / "app" / "demo.toml").sheet_id, remedy


def interval(value: float, low: float, high: float) -> str:
    """In points or %, as the notebook writes them."""
    return f"{100 * value:+.1f} [{100 * low:.1f}, {100 * high:.1f}]".replace("+0.0", "0.0").replace("-0.0", "0.0")


@pytest.mark.parametrize("page", [README, NOTEBOOK, ROOT / ".readme" / "keys.md", CONTRIBUTING], ids=lambda p: p.name)
def test_pictures_and_files_that_pages_name_exist(page):
    for target in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")):
        assert (page.parent / target).exists(), target


def test_a_newcomer_reads_two_screens_and_a_half():
    assert len(README.read_text(encoding="utf-8").splitlines()) <= 180


def test_figures_of_the_readme_are_those_of_the_notebook():
    (section,) = re.findall(r"## Measured\n(.*?)\n## ", README.read_text(encoding="utf-8"), re.DOTALL)
    quoted = re.findall(r"[+-]?\d+(?:\.\d+)?(?: %)?(?: \[[^]]+\])?", section)
    assert len(quoted) >= 9
    for figure in quoted:
        assert figure in words(NOTEBOOK), figure


def test_other_networks_are_as_good_as_their_cards_say():
    for card in (NOTEBOOK.parent / "families" / "networks").glob("*.json"):
        trained = json.loads(card.read_text(encoding="utf-8"))
        rows = [line for line in NOTEBOOK.read_text("utf-8").splitlines() if line.startswith(f"| {card.stem} | ")]
        figures = f"| {trained['weights']:,} | {trained['input_px']} px | {trained['recipe']['epochs']} |"
        assert sum(row.endswith(f"{figures} {100 * trained['held_out_accuracy']:.1f} % |") for row in rows) == 1


def test_figures_of_the_promises_are_the_stored_ones():
    check_picture("promises.png", "promises/promises.json")
    (_, held, width, _, alone, alone_width, _) = stored("promises/promises.json")["tables"]["held"]["rows"][-1]
    count, old = (f"{round(row['value'] * row['n'])} of {row['n']}" for row in (held, alone))
    share = f"{held['value']:.0%} [{100 * held['low']:.0f}, {100 * held['high']:.0f}]".replace("%", " %")
    assert f"{count} sessions lay in their 95 % prediction intervals: {share}." in words(NOTEBOOK)
    assert f"These are {width:.0%} of a session's photographs wide".replace("%", " %") in words(NOTEBOOK)
    assert f"{old} held, with {alone_width:.0%}.".replace("%", " %") in words(NOTEBOOK)


def test_figures_of_the_detector_are_the_stored_ones():
    tables = stored("detector/promises.json")["tables"]
    held = tables["held"]["rows"][-1][1]
    count = f"{round(held['value'] * held['n'])} of {held['n']} sessions lay in their intervals"
    assert f"{count} ({held['value']:.0%} [{100 * held['low']:.0f}, {100 * held['high']:.0f}])".replace(
        "%", " %"
    ) in words(NOTEBOOK)
    shown: dict[str, int] = {}
    for scene, *_, recognized, _, _, _, _ in tables["promises"]["rows"]:
        shown[scene] = shown.get(scene, 0) + recognized
    truck, mailbox, carton, chair = (shown[name] for name in ("truck", "mailbox", "carton", "chair"))
    assert f"Photographed were {truck}, {carton}, {chair} and {mailbox} of 48." in words(NOTEBOOK)
    card = json.loads((ROOT / "src/patchproof/classifier/builtin_detector.json").read_text(encoding="utf-8"))
    assert f"AP50 {card['held_out_ap50']:.3f}" in words(NOTEBOOK)
    tables = stored("detector/two_stage.json")["tables"]
    sessions, held = tables["promises"]["rows"], tables["held"]["rows"][-1][1]
    truck, carton = (100 * sessions[row][6] for row in (0, 4))
    found = [sum(row[9] for row in sessions[first : first + 4]) for first in (0, 4)]
    assert [held["value"], held["n"], round(100 * held["low"])] == [1, 8, 68]
    assert f"Promised {truck:.1f} % (truck) and {carton:.1f} % (carton); 8 of 8 sessions of 12" in words(NOTEBOOK)
    assert f"(100 % [68, 100]), {found[0]} and {found[1]} of 48 were recognized" in words(NOTEBOOK)


def test_gains_of_the_detector_s_other_seeds_are_the_stored_ones():
    gains, shown = dict[str, list[str]](), 0
    for row in csv.DictReader((ROOT / "src/patchlab/results/detector/seeds.csv").read_text("utf-8").splitlines()):
        gains.setdefault(row["object"], []).append(f"{100 * float(row['gain']):+.0f}")
        assert (float(row["gain"]) >= 0.15) == (row["object"] != "mailbox")
        assert float(row["low"]) > 0 or row["object"] == "mailbox"
        shown += row["object"] == "mailbox" and float(row["low"]) > 0
    for name, (first, second, third) in gains.items():
        assert f"{name} {first}, {second} and {third}" in words(NOTEBOOK)
    assert f"which {shown} of the 3 shows" in words(NOTEBOOK)


def test_figures_of_promises_made_again_are_the_stored_ones():
    tables = stored("promises/again.json")["tables"]
    _, held, width, _, formerly, _, bias = tables["held"]["rows"][-1]
    low, high = (f"{100 * held[end]:.0f}" for end in ("low", "high"))
    sessions = f"{round(held['value'] * held['n'])} of {held['n']} sessions lay in their intervals"
    said = f"{sessions} ({held['value']:.0%} [{low}, {high}]; {round(formerly['value'] * formerly['n'])} of 30 by the"
    text = words(NOTEBOOK)
    assert said.replace("%", " %") in text and f"are {width:.0%}".replace("%", " %") in text
    value, low, high = (100 * bias[end] for end in ("value", "low", "high"))
    assert f"sessions showed {-value:.1f} points less than was promised [{low:.1f}, {high:.1f}]" in text
    within = [row[-1] for row in tables["elsewhere"]["rows"]]
    assert f"lay within the promise's in {sum(within)} of {len(within)}" in text


def test_promises_in_the_readme_are_those_by_the_default_conditions():
    names = ("promises/office.json", "promises/office_025.json")
    held = [stored(name)["tables"]["held"]["rows"][-1][1] for name in names]
    count, n = round(sum(each["value"] * each["n"] for each in held)), sum(each["n"] for each in held)
    promised, seen = np.hstack([shown_by_run(name) for name in names])
    off = student_mean(100 * (seen - promised))
    said = f"{count} of {n} sessions that a path tracer photographed, "
    said += f"{off.value:+.1f} points [{off.low:.1f}, {off.high:.1f}] beyond them".replace("-0.0", "0.0")
    assert len(seen) == 20 and said in words(README)


def test_our_photographs_differ_from_the_path_tracers_as_it_is_said():
    said = []
    rows = list(csv.DictReader((ROOT / "src/patchlab/results/promises/traced.csv").read_text("utf-8").splitlines()))
    for shown, form in (("design", "rate {:.1f} points [{:.1f}, {:.1f}]"), ("bare", "{:.1f} [{:.1f}, {:.1f}]")):
        ours = [row for row in rows if row["shown"] == shown]
        rate, sure = (
            student_mean(np.array([float(row[f"{kind}_off"]) for row in ours])) for kind in ("rate", "confidence")
        )
        said.append(form.format(*(100 * end for end in (rate.value, rate.low, rate.high))))
        said.append(f"{sure.value:.3f} [{sure.low:.3f}, {sure.high:.3f}]")
        for row in ours:
            assert abs(float(row["confidence_off"])) < 0.03
    said = [figure.replace("rate -0.0", "rate 0.0") for figure in said]
    assert "the design's {} and confidence {}, the bare object's {} and {}".format(*said) in words(NOTEBOOK)


def test_what_sessions_lack_is_shared_out_as_it_is_said():
    """Between promise and photographs by our renderer, and those and a path tracer's of the same sessions."""
    (promised, traced), (_, ours) = (shown_by_run(f"promises/{name}.json") for name in ("again", "again_ours"))
    for less, more in ((ours, promised), (traced, ours)):
        off = student_mean(100 * (more - less))
        assert f"{off.value:.1f} points less than" in words(NOTEBOOK)
        assert f"[{off.low:.1f}, {off.high:.1f}]" in words(NOTEBOOK)


def shown_by_run(name: str) -> np.ndarray:
    """What was promised and the mean share of its sessions, 2 × runs."""
    found = [cell["found"] for cell in stored(name)["cells"].values()]
    return np.array(
        [
            (
                np.mean(parse_hits(run["promised"])),
                np.mean([seen / judged for seen, judged in run["sessions"] if judged]),
            )
            for run in found
        ]
    ).T


def test_what_drafts_answer_is_stored():
    answers = Counter((row["is"], row["draft"]) for row in rows_of("promises/drafts.csv"))
    for kind, said in (("helps", "that help"), ("does_not_help", "that do not")):
        told = [answers[kind, word] for word in ("helps", "cannot_tell", "does_not_help")]
        assert f"of {sum(told)} designs {said} {told[0]}, {told[1]} and {told[2]}" in words(NOTEBOOK)
        assert sum(told) >= 20
    assert answers["helps", "does_not_help"] == 0 and answers["does_not_help", "helps"] <= 1


def test_finds_of_prints_without_markers_are_the_stored_ones():
    rows = rows_of("find/trials.csv")
    shown = [row for row in rows if row["shown"] == "1"]
    found = [row for row in shown if row["off_px"] and float(row["off_px"]) < 0.1 * float(row["width_px"])]
    unsaid = sum(not row["said"] for row in shown) - len(found)
    off = float(np.percentile([float(row["off_px"]) for row in found], 95))
    low, high = (100 * bound for bound in wilson(len(found), len(shown)))
    share = f"{len(found) / len(shown):.1%}".replace("%", " %")
    said = f"{len(found)} of {len(shown)} prints are found ({share} [{low:.1f}, {high:.1f}]), "
    said += f"{len(shown) - len(found) - unsaid} say that they were not, {unsaid} are found elsewhere than they lie. "
    said += f"Their corners are off by at most {off:.2f} px in 95 %. By over 1 px "
    assert said + f"{sum(float(row['off_px']) > 1 for row in found)} are off," in words(NOTEBOOK)
    held = np.mean([float(row["off_px"]) < 3 * float(row["sigma_px"]) for row in found])
    assert f"three stated standard deviations hold in {held:.1%}".replace("%", " %") in words(NOTEBOOK)
    empty = [row["said"] for row in rows if row["shown"] == "0"]
    assert f"In {len(empty)} pictures of that time without the print" in words(NOTEBOOK) and set(empty) == {
        "no_corners"
    }
    real = [row["said"] for row in rows_of("find/photographs.csv")]
    bound = f"{wilson(0, len(real))[1]:.1%}".replace("%", " %")
    assert set(real) == {"no_corners"}
    assert f"In {len(real)} photographs of other things" in words(NOTEBOOK) and f"[0, {bound}]" in words(NOTEBOOK)


def test_figures_of_imported_designs_are_the_stored_ones():
    tables = stored("promises/imported.json")["tables"]
    (held, rendered), rows = (tables[name]["rows"][-1][1] for name in ("held", "rendered")), tables["elsewhere"]["rows"]
    row = words(NOTEBOOK).partition("| promised 75 and 54 %")
    row = (row[1] + row[2])[2:].partition("11-22")[0]
    for share in (held, rendered):
        count = f"{round(share['value'] * share['n'])} of {share['n']}"
        interval = f"({share['value']:.0%} [{100 * share['low']:.0f}, {100 * share['high']:.0f}])".replace("%", " %")
        assert count in row and interval in row
    promised = [f"{100 * row[3]:.0f}" for row in rows]
    assert row.startswith("promised {} and {} %, {} and {} %, {} and {} %;".format(*promised))
    assert f"in {sum(row[-1] for row in rows)} of {len(rows)}" in row
    verdicts = [row[-1] for row in tables["promises"]["rows"][::5]]  # each is of its design's five sessions
    kept, unsure, broken = (verdicts.count(verdict) for verdict in ("kept", "cannot_tell", "broken"))
    assert f"{kept} designs are `kept`, {unsure} `cannot_tell` and {broken} `broken`" in row
    flat = [row for row in tables["promises"]["rows"] if row[4] == "postbox-flat"]
    recognized, judged = (sum(row[column] for row in flat) for column in (9, 8))
    assert f"{recognized} photograph of {judged}" in row


def test_figures_of_families_are_the_stored_ones():
    tables, page = stored("families/transfer.json")["tables"], NOTEBOOK.read_text(encoding="utf-8").splitlines()
    matrix = tables["matrix"]["rows"]
    gains: dict[str, list[str]] = {}
    for _, row, _, seen, _, _, gain, _ in tables["objects"]["rows"]:
        told = interval(gain["value"], gain["low"], gain["high"])
        gains.setdefault(row.replace("without_", "all but "), []).append(f"*{told}*" if seen == "yes" else told)
    assert len(gains) == 5 + 3
    for row, told in gains.items():
        assert f"| {row} | {' | '.join(told)} |" in page
    for _, _, _, _, before, after, gain, _ in tables["families"]["rows"]:
        told = interval(gain["value"], gain["low"], gain["high"])
        assert any(line.endswith(f" | {100 * before:.0f} % | {100 * after:.0f} % | {told} |") for line in page)
    cnns, vits = ("builtin", "shufflenet", "resnet"), ("levit", "vit")
    gains_of = {(scene, row, seen): gain["value"] for scene, _, row, seen, _, _, gain, *_ in matrix if gain}
    for rows, seen in ((cnns, vits), (vits, cnns)):
        first = ("truck", "carton", "chair")
        gained = [np.mean([gains_of[scene, row, column] for row in rows for column in seen]) for scene in first]
        over = student_mean(gained)
        assert "{:.1f}, {:.1f} and {:.1f}".format(*(100 * gain for gain in gained)) in words(NOTEBOOK)
        assert f"({interval(over.value, over.low, over.high)})" in words(NOTEBOOK)


def rows_of(name: str) -> list[dict[str, str]]:
    with (NOTEBOOK.parent / name).open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_figures_of_a_step_are_the_stored_ones():
    told = {"mobilenet_v2_1.0_224": "MobileNetV2 1.0", "squeezenet1.1_224": "SqueezeNet 1.1"}
    rows = rows_of("speed/step.csv")
    assert len(rows) == 8
    for alone, shared in zip(rows[::2], rows[1::2], strict=True):
        name = told.get(alone["network"], "ResNet-50 of random weights")
        name = "with every effect on" if alone["scene"] == "effects" else name
        parts = [
            ", ".join(f"{float(row[part]) / float(row['pass_ms']):.2f}" for part in ("new_ms", "again_ms"))
            for row in (alone, shared)
        ]
        ratios = [f"{float(row['ratio']):.2f}" for row in (alone, shared)]
        assert f"| {name} | {' | '.join(ratios + parts)} |" in words(NOTEBOOK)


def test_predicted_speeds_are_the_stored_ones():
    told, times = {"builtin": "built-in", "mobilenet_v2_1.0_224": "MobileNetV2"}, dict[tuple[str, ...], list[str]]()
    for row in rows_of("speed/cores.csv"):
        if row["cores"] != "1":
            key = told[row["network"]], row["views"], row["batch"]
            times.setdefault(key, []).append(f"{float(row['times_as_fast']):.2f}")
    rows = [f"| {name}, {views}, {batch} | {' | '.join(each)} |" for (name, views, batch), each in times.items()]
    assert sum(row in words(NOTEBOOK) for row in rows) == 10  # those of batches that are shared among more cores


def test_medians_of_printed_boards_are_the_stored_ones():
    boards: dict[str, list[float]] = {}
    for row in rows_of("real/real_boards.csv"):
        boards.setdefault(row["board"], []).append(float(row["median"]))
    for name in ("grid", "charuco", "loose"):
        rms, p95, edge, ours, overshoot = next(each for board, each in boards.items() if name in board)[:5]
        cells = f"{rms:.1f} / {p95:.0f} | {edge:.2f} / {ours:.2f} | {100 * overshoot:.0f} %"
        assert f") | {cells} |" in words(NOTEBOOK), name


def test_figures_of_windows_are_the_stored_ones():
    rows, told = (
        rows_of("speed/windows.csv"),
        ("MobileNetV2 1.0", "SqueezeNet 1.1", "MobileNet v1 0.75", "MobileNet v1 0.25"),
    )
    assert len(rows) == 24 and {row[of] for row in rows for of in ("difference", "beside_difference")} == {"0.0e+00"}
    assert f"| network | what is asked for | {' | '.join(row['share'] for row in rows[:6])} |" in words(NOTEBOOK)
    for number, name in enumerate(told):
        for asked, ratio in (("gradients", "ratio"), ("answers", "beside_ratio")):
            ratios = [f"{float(row[ratio]):.2f}" for row in rows[6 * number : 6 * number + 6]]
            assert f"| {name} | {asked} | {' | '.join(ratios)} |" in words(NOTEBOOK)


def test_figures_of_views_are_the_stored_ones():
    page, rows = words(NOTEBOOK), rows_of("views/views.csv")
    assert len(rows) == 10
    for design, bare in zip(rows[::2], rows[1::2], strict=True):
        assert (design["scene"], design["shown"], bare["shown"]) == (bare["scene"], "design", "bare")
        off = " | ".join(
            f"{float(row['confidence_off']):+.3f} ± "
            f"{(float(row['confidence_high']) - float(row['confidence_low'])) / 2:.3f}"
            for row in (design, bare)
        )
        rates = f"{float(design['views_rate']):.1%} in views, {float(design['photographs_rate']):.1%} in photographs"
        sizes = f"{design['view_px']}, {design['photo_px']}"
        assert f"| {sizes} | {off} | {rates.replace('%', ' %')} |" in page


def test_figures_of_verdicts_are_those_of_the_chart():
    good = {
        (row[1], row[2]): f"{100 * row[3]:.0f} %"
        for row in stored("charts/breaks.json")["tables"]["points"]["rows"]
        if row[0] == "verdict"
    }
    by_sessions = (good["sessions of 96 photographs", count] for count in (8, 4, 3))
    assert "it in {} of 200 draws in 8 sessions, {} in 4 and {} in 3".format(*by_sessions) in words(NOTEBOOK)
    below = (good["points under the promise", points] for points in (3, 6))
    assert "3 points under the promise in {}, 6 points under it in {}".format(*below) in words(NOTEBOOK)


def test_gains_of_the_readme_are_those_of_the_chart():
    tables = stored("charts/speed.json")["tables"]
    gains = {
        name: "{:.1f}".format(100 * gain["value"]) + " [{:.1f}, {:.1f}]".format(100 * gain["low"], 100 * gain["high"])
        for name, _, gain, _ in tables["methods"]["rows"]
    }
    assert f"--thorough 127 s and {gains['--thorough']}" in words(NOTEBOOK)
    assert f"the default 36 s and {gains['default']}" in words(NOTEBOOK)
    default = gains["default"].replace(" [", " points [")
    assert f"In six pairs of object and network designs gain {default}" in words(README)
    assert "6 pairs of object and network" in tables["methods"]["about"]
    beyond = [100 * row[3] for row in tables["ceiling"]["rows"]]
    said = (
        "is {:.1f} points above the default for the truck, {:.1f} for the chair (two places), {:.1f} for the letter box"
    )
    assert (said + " and {:.1f} for the traffic light").format(*beyond) in words(NOTEBOOK)


def test_figures_of_terms_are_those_of_the_chart():
    rows = {row[0]: row[2:] for row in stored("charts/terms.json")["tables"]["terms"]["rows"]}
    off = {name: f"{100 * row[0]['value']:.1f}" for name, row in rows.items()}
    page = words(NOTEBOOK)
    said = "only ambient light ({} points), the printer's colors ({}) and directional light ({}) move some promise"
    assert said.format(*(off[name] for name in ("ambient light", "printer's colors", "directional light"))) in page
    said = "a veil {}, tone {}, mottle {}, chroma {}, exposure {}, all others less"
    assert said.format(*(off[name] for name in ("veil", "tone", "mottle", "chroma", "exposure"))) in page
    costs = {name: [100 * row[3][end] for end in ("value", "low", "high")] for name, row in rows.items()}
    said = "mottle takes {:.1f} % [{:.1f}, {:.1f}] and exposure {:.1f} [{:.1f}, {:.1f}]; every other"
    assert said.format(*costs.pop("mottle"), *costs.pop("exposure")) in page
    assert all(low < 0 < high for _, low, high in costs.values())


def test_figures_of_effects_are_the_stored_ones():
    page, effects = words(NOTEBOOK), rows_of("effects/effects_effects.csv")[-1]
    off = (100 * float(effects[f"estimated minus photographed{end}"]) for end in ("", "_low", "_high"))
    assert "by {:.1f} points [{:.1f}, {:.1f}] of".format(*off) in page
    assert f"of an effect of {100 * float(effects['photographed effect']):.0f};" in page
    assert float(effects["interval held"]) == 1 and int(effects["interval held_n"]) == 30


def test_sessions_and_rates_in_other_places_are_the_stored_ones():
    both = [stored(f"promises/{name}.json")["tables"] for name in ("promises", "places")]
    rendered = [table["rendered"]["rows"][-1] for table in both]
    held, alone = (sum(round(row[i]["value"] * row[i]["n"]) for row in rendered) for i in (1, 4))
    sessions = sum(row[1]["n"] for row in rendered)
    said = f"{held} of {sessions} sessions of 20 lay in their intervals; where photographs are taken for independent "
    assert said + f"{alone}." in words(NOTEBOOK)
    rates = [row for table in both for row in table["elsewhere"]["rows"]]
    assert [row[4] <= row[6]["value"] <= row[5] for row in rates] == [row[7] for row in rates]
    within = sum(row[7] for row in rates)
    said = f"the rate in 800 places that the promise did not know lay in its interval in {within} of {len(rates)} runs;"
    assert {row[6]["n"] for row in rates} == {800} and said in words(NOTEBOOK)


def test_figures_of_the_ablation_are_the_stored_ones():
    with (NOTEBOOK.parent / "ablation" / "ablation_earned.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    lines = NOTEBOOK.read_text(encoding="utf-8").splitlines()
    told = {"blur + motion blur": "blur, motion blur"}
    told |= {row["trained without"]: "dot gain, ink density, black, paper white" for row in rows[6:7]}
    told |= {row["trained without"]: "all that is off by default" for row in rows[-2:-1]}
    told |= {row["trained without"]: "everything" for row in rows[-1:]}
    assert len(rows) == 16
    for row in rows:
        earned, traced = (
            interval(*(float(row[f"{key}{end}"]) for end in ("", "_low", "_high")))
            for key in ("rate", "rate, path-traced")
        )
        name = told.get(row["trained without"], row["trained without"])
        assert f"| {name} | {earned} | {traced} |" in lines, name


@pytest.mark.parametrize(("name", "count"), [("chances", 8), ("again", 2)])
def test_figures_of_terms_in_their_best_scenes_are_the_stored_ones(name, count):
    missed, earned = (rows_of(f"ablation/chances/{name}_{table}.csv") for table in ("missed", "earned"))
    lines = NOTEBOOK.read_text(encoding="utf-8").splitlines()
    assert len(missed) == len(earned) == count
    for row, other in zip(missed, earned, strict=True):
        off, knowing = (
            interval(*(float(each[f"rate{end}"]) for end in ("", "_low", "_high"))) for each in (row, other)
        )
        figures = f"{off} | {float(row['confidence']):+.3f} | {100 * float(row['largest']):+.1f}"
        end = f"| {figures} | {row['outside']} of {row['designs']} | {knowing} |"
        assert sum(line.endswith(end) for line in lines) == 1, row["left out"]


@pytest.mark.parametrize(
    ("name", "network", "stored_as"),
    [
        ("procedural", "builtin", "builtin"),
        ("levit", "LeViT", "levit"),
        ("meshes", "MobileNet v1 0.25", "mobilenet_v1_0.25_128"),
        ("meshes", "MobileNet v1 0.75", "mobilenet_v1_0.75_192"),
        ("meshes", "SqueezeNet 1.1", "squeezenet1.1_224"),
    ],
)
def test_figures_of_hardened_renders_are_the_stored_ones(name, network, stored_as):
    lines = NOTEBOOK.read_text(encoding="utf-8").splitlines()
    rows = [row for row in rows_of(f"harden/{name}_accuracy.csv") if row["network"] == stored_as]

    def percent(row: dict[str, str], key: str) -> str:
        value, low, high = (100 * float(row[f"{key}{end}"]) for end in ("", "_low", "_high"))
        return f"{value:.1f} [{low:.1f}, {high:.1f}]"

    for attack in dict.fromkeys(row["attack"] for row in rows):
        under = [row for row in rows if row["attack"] == attack]
        assert [row["epsilon"] for row in under] == ["0.01", "0.02", "0.04"]
        kind, _, epsilon = attack.partition(" ")
        under_what = f"{kind.upper()} {epsilon}" if epsilon else "no attack"
        figures = [percent(under[0], "original"), *(percent(row, "hardened") for row in under)]
        assert f"| {network} | {under_what} | {' | '.join(figures)} |" in lines
    gained = [row for row in rows if row["attack"] == "pgd 0.01" and float(row["gain_low"]) > 0]
    assert bool(gained) == (name != "meshes"), "of a thousand labels none gains"
    for row in gained:
        value, _, rest = percent(row, "gain by class").partition(" ")
        assert re.search(rf"\+{value}( points, over the twelve classes)? {re.escape(rest)}", words(NOTEBOOK))
    moved = (
        f"{float(row['RMS']):.3f}, {float(row['SSIM']):.2f}"
        for row in rows_of(f"harden/{name}_moved.csv")
        if row["hardened for"] == stored_as
    )
    assert f"| {network} | RMS moved, SSIM | | {' | '.join(moved)} |" in lines


@pytest.mark.parametrize("name", ["speed", "breaks", "terms"])
def test_charts_say_of_themselves_what_is_stored(name):
    """The notebook quotes each chart's own line, and its picture, drawn from the same values, is in the README."""
    first = next(iter(stored(f"charts/{name}.json")["tables"].values()))
    check_picture(f"charts/{name}_chart.png", f"charts/{name}.json")
    assert first["about"] in words(NOTEBOOK) and f"results/charts/{name}_chart.png" in README.read_text("utf-8")


def test_figures_of_finding_sheets_are_those_of_the_chart():
    rows = stored("charts/speed.json")["tables"]["photos"]["rows"]
    told = {"ours": "ours", "ArUco": "OpenCV's ArUco", "ArUco subpixel": "the same, refined", "AprilTag": "AprilTag"}
    for name, size, speed, off, right in rows:
        photograph = size if name == "ours" else ""
        figures = f"{speed['value']:.2g} | {off['value']:.3f} | {100 * right:.0f} %"
        assert " ".join(f"| {photograph} | {told[name]} | {figures} |".split()) in words(NOTEBOOK)
    ours, theirs = (next(row for row in rows if row[:2] == [name, "4000 × 3000"]) for name in ("ours", "ArUco"))
    said = "found in {} of 24 photographs of 12 megapixels, {:.1f} a second and core, its corners {:.3f} px off in the "
    said = said.format(round(24 * ours[4]), ours[2]["value"], ours[3]["value"])
    assert said + f"median; OpenCV's ArUco {theirs[2]['value']:.0f} and {theirs[3]['value']:.3f}" in words(README)


def test_figures_of_cards_are_the_stored_ones():
    accuracy = json.loads((PACKAGE / "classifier" / "builtin.json").read_text())["held_out_accuracy"]
    assert f"names {100 * accuracy:.1f} % of 2,400 renders" in words(NOTEBOOK)
    names = ("coated", "uncoated")  # from profiles
    printers = [json.loads((ROOT / "calibration" / "printers" / f"{name}.json").read_text()) for name in names]
    errors = [printer["provenance"]["delta_e00_to_exact_chain"] for printer in printers]
    means, p95s, worst = (" / ".join(f"{one[key]:.2f}" for one in errors) for key in ("mean", "p95", "max"))
    assert f"ΔE00 mean {means}, p95 {p95s}, max {worst} (coated / uncoated)" in words(NOTEBOOK)


def test_the_table_of_rooms_has_the_order_of_imports():
    rooms = re.findall(r"^\| `(\w+)/?` \|", CONTRIBUTING.read_text(encoding="utf-8"), re.MULTILINE)
    assert rooms == [room for room in MAY_IMPORT if not room.startswith("__")]


def test_the_two_commands_are_there():
    text = README.read_text(encoding="utf-8")
    assert "pip install . && patchproof demo" in text and 'pip install -e ".[test]" && pytest' in text


def test_figures_of_a_gpu_are_the_stored_ones():
    page = words(NOTEBOOK)
    for scene, name in (("suv", "SUV, MobileNetV2 1.0"), ("truck", "truck, builtin")):
        row = {line["quantity"]: line for line in rows_of("cuda/cuda.csv") if line["scene"] == scene}
        gpu = {quantity: float(line["gpu"]) for quantity, line in row.items()}
        step = f"{float(row['median step, ms']['cpu']):.0f}, {gpu['median step, ms']:.0f}"
        views = ", ".join(f"{gpu[f'new views a second, {count} together']:.0f}" for count in (4, 256))
        off = f"{100 * gpu['relative difference of the gradient']:.2g} %"
        pixel, confidence = gpu["largest difference of a pixel"], gpu["largest difference of a confidence"]
        alike = f"{gpu['answers alike of 96']:.0f} of 96"
        assert f"| {name} | {pixel:.2g} | {off} | {alike} | {confidence:.2g} | {step} | {views} |" in page
