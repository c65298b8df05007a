"""A new user's first two hours: every step as it is typed, what it says, and how it exits.

`python tests/test_first_hour.py` types all of it into one fresh folder: an own mesh with an own network and a messy
folder of photographs, the README's blocks one after the other, the examples, and the verbs that these leave out. It
prints what each step says and the processor time of its process, and writes exit codes, answers and last lines of all
but the first into `first_hour.txt`; names of journeys as arguments choose some, which replace their part of that file.
The tests type the first into one process and look at the words, and compare the file with the README.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import os
import re
import resource
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
import trimesh
from PIL import Image

NETWORK = '''
import torch


class Lamps(torch.nn.Module):
    """How much of a picture is orange beside blue, by one small convolution with fixed weights."""

    input_px, labels = 64, ["lamp", "vase", "stone"]

    def __init__(self):
        super().__init__()
        self.beside, self.head = torch.nn.Conv2d(3, 1, 4, padding=2), torch.nn.Linear(1, 3)
        with torch.no_grad():
            color, side = torch.tensor([1.0, 0, -1]).view(1, 3, 1, 1), torch.tensor([1.0, 1, -1, -1])
            self.beside.weight.copy_(color * side.expand(1, 1, 4, 4) / 8)
            self.beside.bias.fill_(-0.33)
            self.head.weight.copy_(torch.tensor([[40.0], [-40], [-20]]))
            self.head.bias.copy_(torch.tensor([-1.6, 1.6, -1]))

    def forward(self, photos):
        return self.head(torch.nn.functional.softplus(10 * self.beside(photos)).mean((2, 3)))
'''
MODEL = "module:lamps.Lamps"
# what is typed, and the exit code; the refused ones are what a newcomer tries first
HOUR = (
    (f"new lantern.glb --models {MODEL}", 1),
    (f"new lantern.glb --models {MODEL} --label lamp", 0),
    ("preview scene.toml", 0),
    ("optimize scene.toml --draft --out run", 0),
    ("sheet run --out sheet.pdf", 0),
    ("reprint sheet.pdf --run run --n 8 --sessions 4 --out photos", 0),
    ("verify photos --sheet sheet.json --out report", 1),
    (f"verify photos --sheet sheet.json --out report --models {MODEL}", 0),
)
SECONDS = {"preview": 5, "all": 60}  # of processor time, at most: `all` are new, preview, optimize and sheet
Typed = Callable[[str, Path], tuple[int, str, float]]


def prepared(folder: Path) -> None:
    """The user's own things: a lantern of 340 mm as a GLB (y up, in meters), and a network."""
    parts = {"foot": (0.22, 0.03, 0.22, 0.015), "body": (0.2, 0.28, 0.2, 0.17), "knob": (0.05, 0.03, 0.05, 0.325)}
    boxes = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix([0, y, 0])) for *size, y in parts.values()
    ]
    trimesh.util.concatenate(boxes).export(folder / "lantern.glb")
    (folder / "lamps.py").write_text(NETWORK, encoding="utf-8")


def messed_up(photos: Path) -> None:
    """What collects in such folders: thumbnails, copies, a screenshot, a video, a raw file, notes, droppings."""
    first, second, third, *_ = sorted(path for path in photos.iterdir() if path.is_dir())
    (first / "thumbnails").mkdir()
    shot, other = sorted(first.glob("*.jpg"))[0], sorted(second.glob("*.jpg"))[0]
    with Image.open(shot) as picture:
        picture.thumbnail((160, 160))
        picture.save(first / "thumbnails" / shot.name)
    for number in (1, 2):
        (second / f"{other.stem} ({number}).jpg").write_bytes(other.read_bytes())
    with Image.open(sorted(third.glob("*.jpg"))[0]) as picture:
        picture.crop((40, 40, picture.width, picture.height)).save(third / "Screenshot 2026-11-22.png")
    (third / "IMG_0007.MOV").write_bytes(b"\0\0\0\x14ftypqt  " + bytes(200))
    (third / "IMG_0008.CR2").write_bytes(b"II*\0" + bytes(200))
    (photos / "notes.txt").write_text("by the window\n", encoding="utf-8")
    (photos / ".DS_Store").write_bytes(bytes(9))
    (third / "._photo.jpg").write_bytes(bytes(99))


def spent(folder: Path, typed: Typed, settings: str = "") -> dict[str, tuple[str, float]]:
    """What each line said, and its seconds; every line has to end as `HOUR` says. Settings are added to the scene."""
    prepared(folder)
    said = {}
    for line, wanted in HOUR:
        code, text, seconds = typed(line, folder)
        assert code == wanted, f"{line}: {code}\n{text}"
        said[line] = text, seconds
        if line.startswith("new") and code == 0:
            edited = (folder / "scene.toml").read_text(encoding="utf-8").replace("340  ", "345  ")  # as measured
            (folder / "scene.toml").write_text(edited + settings, encoding="utf-8")
        if line.startswith("reprint"):
            messed_up(folder / "photos")
    return said


def typed_here(line: str, folder: Path) -> tuple[int, str, float]:
    """In this process."""
    from patchproof.app.cli import main

    text = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        patch.chdir(folder)
        patch.setattr(sys, "argv", ["patchproof", *line.split()])
        with pytest.raises(SystemExit) as stop:
            main()
    return int(stop.value.code or 0), text.getvalue(), 0.0


def typed_apart(line: str, folder: Path) -> tuple[int, str, float]:
    """In a process of its own, on one core, and the time of it; a Python program in its own folder."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    program, *words = shlex.split(line)
    if program == "python":
        folder, words = (folder / words[0]).parent, [Path(words[0]).name]
    command = [sys.executable, *words] if program == "python" else [sys.executable, "-m", program, *words]
    done = subprocess.run(
        command,
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
    )
    return done.returncode, done.stdout, resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def test_a_first_hour_says_at_each_step_what_to_do_next(tmp_path, monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 8)  # what they cost is time
    monkeypatch.setattr("patchproof.optimizer.run.DRAFT_EFFORT", (24, 40))
    small = "[camera]\nphoto_px = [1040, 780]\n[background]\ncolor = [0.5, 0.5, 0.5]\n"
    said = {line: text for line, (text, _) in spent(tmp_path, typed_here, small).items()}
    asked, new, preview, optimize, sheet, _, refused, verify = said.values()
    assert 'add --label with what it is to be recognized as: "lamp", "vase", "stone"' in asked
    assert "length: 340 mm, by the file's units" in new and "next: patchproof preview scene.toml" in new
    assert '"lamp" recognized in ' in preview and "next: patchproof optimize scene.toml" in preview
    assert "Draft of" in optimize and "(preliminary): helps" in optimize
    assert "next: patchproof sheet run --out sheet.pdf" in optimize and "sheet.json" in sheet
    assert f"or name the networks yourself (--models '{MODEL}')" in refused
    assert "Helps (controls rendered into these photographs)" in verify and "verdict: kept" in verify
    assert "photographs: 11, judged 8, measured 7" in verify  # one is overexposed
    for named in (
        "copy: 2",
        "copy: 1 (session_03/Screenshot 2026-11-22.png): it shows what session_03/",
        "IMG_0007.MOV",
        "IMG_0008.CR2",
        "thumbnails",
    ):
        assert named in verify, named
    assert not any(word in verify for word in ("notes.txt", ".DS_Store", "._photo.jpg"))


ROOT = Path(__file__).resolve().parents[1]
README, RECORD = (ROOT / "README.md").read_text(encoding="utf-8"), Path(__file__).with_name("first_hour.txt")
SECOND_HOUR = """
patchproof new primitive:mug --out mug.toml
patchproof preview mug.toml
patchproof plan mug.toml
patchproof optimize small.toml --draft --out small
patchproof promise small
patchproof sheet small --template letter --out small.pdf
patchproof reprint small.pdf --run small --n 48 --sessions 12 --out shots
patchproof sheet small --control mean --out mean.pdf
patchproof reprint mean.pdf --run small --n 48 --sessions 12 --out controls/mean
patchproof verify shots --sheet small.json --controls controls --require helps --out decided
patchproof sheet small --out sheet.pdf --overwrite
patchproof reprint sheet.pdf --run small --n 4 --seed 2 --out desk
patchproof reprint sheet.pdf --run small --n 4 --seed 3 --out window
patchproof calibrate printer desk window --design --sheet sheet.json --out mine
patchproof keys
patchlab table
"""
# the blank sheet on the object is photographed by the example of photographs
PHOTOGRAPHS = """
patchproof sheet --template blank_a4 --out blank.pdf
cp programs/blank.json blank.json
cp -r programs/blank-photos blanks
patchproof optimize photographs.toml --out hung
patchproof sheet hung --out hung.pdf
patchproof reprint hung.pdf --run hung --n 48 --sessions 12 --out hangings
patchproof verify hangings --sheet hung.json --controls blanks --out hung-report
"""


def blocks(language: str) -> list[str]:
    """The README's blocks of a language."""
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def journeys() -> dict[str, list[str]]:
    """What is typed, by journey, in this order."""
    import patchproof

    programs = sorted((Path(patchproof.__file__).parent / "app" / "examples").glob("*.py"))
    return {
        "README": ["python eight_lines.py", *blocks("console")[0].splitlines()],
        "examples": ["patchproof examples programs", *(f"python programs/{path.name}" for path in programs)],
        "second": SECOND_HOUR.split("\n")[1:-1],
        "photographs": PHOTOGRAPHS.split("\n")[1:-1],
        "demo": ["patchproof demo"],
    }


def write_files(folder: Path) -> None:
    """The README's blocks as files, and its scene with smaller photographs."""
    scene, photographs = blocks("toml")[:2]
    small = f"{scene}[camera]\nphoto_px = [1040, 780]\n"
    texts = {"scene.toml": scene, "photographs.toml": photographs, "small.toml": small}
    for name, text in {**texts, "eight_lines.py": blocks("python")[0]}.items():
        (folder / name).write_text(text, encoding="utf-8")


def answers_of(text: str) -> list[str]:
    """The lines that a reader looks for: the first, verdicts, what comes next, the last; no progress."""
    lines = [line for line in text.splitlines() if line.strip() and not re.fullmatch(r"\w+: \d+ of \d+", line)]
    told = re.compile(r"(verdict|next|Take|No \d+|kept|broken|cannot_tell|warning)\b")
    return [line for number, line in enumerate(lines) if number in (0, len(lines) - 1) or told.match(line)]


def record_text(line: str, code: int, text: str) -> str:
    """A line's part of `first_hour.txt`."""
    return "\n".join([f"$ {line}", f"[{code}]", *answers_of(text)]) + "\n"


def type_journey(lines: list[str], folder: Path) -> str:
    """Type lines, print what they say, and return their part of `first_hour.txt`."""
    said = ""
    for line in lines:
        if line.startswith("cp "):
            subprocess.run(line.split(), cwd=folder, check=True)
            continue
        code, text, seconds = typed_apart(line, folder)
        print(f"$ {line}   # {seconds:.1f} s\n{text}", flush=True)
        said += record_text(line, code, text)
    return said


def type_lantern(folder: Path) -> None:
    """Type `HOUR`, and print what it says and the time of each step."""
    folder.mkdir()
    hour = spent(folder, lambda line, folder: typed_apart(f"patchproof {line}", folder))
    for line, (text, seconds) in hour.items():
        print(f"$ patchproof {line}   # {seconds:.1f} s\n{text}")
    verbs = {}
    for line, (_, seconds) in hour.items():
        verbs[line.split()[0]] = verbs.get(line.split()[0], 0) + seconds
    whole = sum(verbs[verb] for verb in ("new", "preview", "optimize", "sheet"))
    print("| step | processor time |\n|---|---|")
    print("\n".join(f"| `{line}` | {seconds:.1f} s |" for line, (_, seconds) in hour.items()))
    print(f"| new, preview, optimize and sheet (asked: {SECONDS['all']}) | {whole:.1f} s |")
    print(f"| preview (asked: {SECONDS['preview']}) | {verbs['preview']:.1f} s |")


def type_all(names: list[str], folder: Path) -> None:
    """Type the named journeys, or all, and replace their parts of `first_hour.txt`."""
    if not names or "lantern" in names:
        type_lantern(folder / "lantern")
    write_files(folder)
    parts = record()
    for name, lines in journeys().items():
        if not names or name in names:
            parts[name] = type_journey(lines, folder)
            text = "\n".join(f"# {key}\n{parts[key].strip()}\n" for key in journeys() if key in parts)
            RECORD.write_text(text, encoding="utf-8")


def record() -> dict[str, str]:
    """What was said, by journey."""
    text = RECORD.read_text("utf-8") if RECORD.exists() else ""
    return dict(re.findall(r"^# (\w+)\n(.*?)(?=^# \w+\n|\Z)", text, re.DOTALL | re.MULTILINE))


def test_the_record_holds_the_readme_s_commands_and_each_journey_ends_in_an_answer():
    """A verdict, or that it cannot be told yet and what tells."""
    entries = {}
    for entry in "".join(record().values()).split("$ ")[1:]:
        line, code, *answers = entry.strip().splitlines()
        entries[line] = int(code.strip("[]")), answers
    typed = {name: {line for line in lines if not line.startswith("cp ")} for name, lines in journeys().items()}
    assert {*entries} == set().union(*typed.values())
    for line, (code, answers) in entries.items():
        assert code == 0 and answers, line
        if line.split()[1] == "verify" or line.startswith("python"):
            said = " ".join(answers)
            assert re.search("kept|broken|cannot_tell", said), line
            assert "annot" not in said or re.search(r"Take|Even \d+ photographs|patchproof promise", said), line


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="journeys, by default all")
    parser.add_argument("--folder", type=Path, help="where the journeys before these were typed")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        type_all(chosen.names, chosen.folder or Path(place))
