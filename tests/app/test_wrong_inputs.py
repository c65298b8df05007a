"""Wrong files and settings through the command line: one sentence each and exit code 1, before torch is imported."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from console import command

from patchproof.base.text import command_text

TABLES = {
    "object": 'mesh = "primitive:mug", length_mm = 100',
    "patch": "width_mm = 50, height_mm = 50",
    "target": 'label = "mug", models = ["builtin"]',
}
# by name, tables in place of those above
SCENES = {
    "no patch": {"patch": None},
    "an unknown table": {"lamp": "watts = 3"},
    "an unknown key": {"patch": "width = 50"},
    "no label": {"target": 'models = ["builtin"]'},
    "no network": {"target": 'label = "mug", models = []'},
    "a negative width": {"patch": "width_mm = -50, height_mm = 50"},
    "a width in words": {"patch": 'width_mm = "wide", height_mm = 50'},
    "a width alone": {"patch": "width_mm = 50"},
    "two objects": {"object": 'mesh = "primitive:mug", length_mm = 9, photos = "p", sheet = "s.json"'},
    "no length": {"object": 'mesh = "primitive:mug"'},
    "no object": {"object": 'up = "y"'},
    "an axis that is none": {"object": 'mesh = "primitive:mug", length_mm = 9, up = "x"'},
    "a range from high to low": {"view": "azimuth_deg = [60, -60]"},
    "a range of one": {"view": "azimuth_deg = [60]"},
    "not a number": {"view": "azimuth_deg = [nan, 60]"},
    "an endless range": {"light": "ambient = [0, inf]"},
    "a camera above itself": {"view": "elevation_deg = [0, 100]"},
    "a field of view of 200": {"view": "fov_deg = 200"},
    "no steps": {"optimize": "steps = 0"},
    "half a step": {"optimize": "steps = 1.5"},
    "an unknown optimizer": {"optimize": 'optimizer = "adagrad"'},
    "a photograph of 8 pixels": {"camera": "photo_px = [8, 8]"},
    "an unknown side": {"patch": 'width_mm = 50, height_mm = 50, side = "+w"'},
    "a place that is given and searched": {"patch": 'width_mm = 5, height_mm = 5, place = "auto", at_mm = [0, 0, 0]'},
    "a search of a given place": {"patch": "width_mm = 5, height_mm = 5, search = {upright = true}"},
    "a mask that is missing": {"patch": 'kind = "masked"'},
    "a texture that bends": {"patch": 'kind = "texture", bend = true'},
    "a patch with an original": {"patch": "width_mm = 5, height_mm = 5, epsilon = 0.1"},
    "two backgrounds": {"background": 'images = "p", color = [0, 0, 0]'},
    "a color beyond white": {"background": "color = [0, 0, 2]"},
    "markers without a page": {"sheet": 'template = "none"'},
    "a goal that is none": {"target": 'label = "mug", models = ["builtin"], goal = "win"'},
    "a mesh that is missing": {"object": 'mesh = "no.glb", length_mm = 9'},
    "a variable that is not set": {"object": 'mesh = "${NOT_SET_ANYWHERE}/a.glb", length_mm = 9'},
    "photographs that are missing": {"object": 'photos = "no", sheet = "no.json"', "patch": ""},
    "images that are missing": {"object": 'images = "no", labels = "no.csv"'},
    "places that are missing": {"background": 'images = "no"'},
    "a printer that is missing": {"printer": 'profile = "no.npz"'},
}
# files of a folder, and commands there; * is the good scene
FILES = {
    "broken.toml": "[object\n",
    "latin.toml": b"\xe9 = 1",
    "wide.toml": "[object]".encode("utf-16"),
    "empty.toml": "",
    "broken.json": "{",
    "list.json": "[]",
    "old.json": '{"version": 1}',
    "text.txt": "text",
    "run/checkpoint.safetensors": "",
    "folder/a.txt": "",
}
COMMANDS = """
    plan no.toml | plan broken.toml | plan latin.toml | plan wide.toml | plan empty.toml | plan folder
    optimize no.toml --out o | preview no.toml --out o | import no.png * --out o | import text.txt no.toml --out o
    promise no | promise folder | promise run | evaluate no | sheet no --out s.pdf | sheet run --out s.pdf
    reprint no.pdf --n 1 --out o | reprint no.pdf --n 1 --out o --run run | verify no --sheet no.json --out o
    verify folder --sheet no.json --out o | verify folder --sheet broken.json --out o
    verify folder --sheet list.json --out o | verify folder --sheet old.json --out o | capture no.json
    calibrate camera no | calibrate printer --out p.npz --icc no.icc
    calibrate printer --out p.npz no.jpg --sheet no.json | new no.glb | new no/ | new no.obj --length-mm 90
"""


@pytest.fixture(scope="module")
def lines(tmp_path_factory) -> list[list[str]]:
    """The commands' words, with the scenes and files that they name."""
    folder = tmp_path_factory.mktemp("wrong")
    for name, content in FILES.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    for name, tables in ({"good": {}} | SCENES).items():
        rows = (f"{key} = {{{row}}}\n" for key, row in (TABLES | tables).items() if row is not None)
        (folder / f"{name}.toml").write_text("".join(rows))
    words = [line.split() for line in COMMANDS.replace("\n", "|").replace("*", "good.toml").split("|") if line.strip()]
    words += [["plan", f"{name}.toml"] for name in SCENES]
    paths = {path.name for path in folder.iterdir()}

    def placed(word: str) -> str:
        return str(folder / word) if word in paths or word.partition(".")[0] in ("no", "no/", "o", "s", "p") else word

    return [[placed(word) for word in line] for line in words]


def test_each_is_one_sentence_before_torch_is_there(lines):
    """Torch takes seconds to import, from three quarters of a second on an idle machine."""
    code = (
        "import contextlib, io, json, sys\nfrom patchproof.app.cli import main\nanswers = []\n"
        "for sys.argv in json.load(sys.stdin):\n"
        "    with contextlib.redirect_stderr(io.StringIO()) as error:\n"
        "        try: main()\n        except SystemExit as stop: answers.append([stop.code, error.getvalue()])\n"
        "    assert 'torch' not in sys.modules, sys.argv\n"
        "print(json.dumps(answers))"
    )
    sent = json.dumps([["patchproof", *line] for line in lines])
    done = subprocess.run([sys.executable, "-c", code], input=sent, text=True, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr[-500:]
    answers = json.loads(done.stdout)
    assert len(answers) == len(lines) >= 60
    for line, (status, error) in zip(lines, answers, strict=True):
        assert status == 1 and error.startswith("Expected ") and error.endswith(".\n"), (line, error)
        assert error.count("\n") == 1 and ", got " in error, (line, error)


def test_a_missing_mesh_is_named_and_no_label_is_asked_for(lines, capsys):
    (line,) = (line for line in lines if line[0] == "new" and line[-1].endswith("no.glb"))
    assert command(*line) == 1 and f"no file at {line[-1]}: check the path" in capsys.readouterr().err


def test_a_pdf_in_place_of_its_manifest_is_told_so(tmp_path, capsys):
    (tmp_path / "sheet.pdf").write_bytes(b"%PDF-1.7\n%\xbf\xf7\n")
    assert command("verify", tmp_path, "--sheet", tmp_path / "sheet.pdf", "--out", tmp_path / "o") == 1
    assert "sheet.pdf, a PDF: name the JSON that was written beside the PDF." in capsys.readouterr().err


def test_hints_quote_what_a_shell_would_split():
    assert command_text("sheet", Path("my run"), "--out", "a.pdf") == "patchproof sheet 'my run' --out a.pdf"


@pytest.mark.parametrize("verb", ["optimize", "evaluate", "reprint"])
def test_seeds_beyond_32_bits_are_refused_by_their_option(verb, tmp_path, capsys):
    path = tmp_path / "any"
    assert command(verb, path, "--out", path, "--seed", 10**20) == 2
    assert "less than or equal to 4294967295" in capsys.readouterr().err
