"""A new user's first hour: own mesh, own network, a messy folder of photographs; every step as it is typed.

`python tests/test_first_hour.py` prints what each step says and the processor time of its process; the test types the
same lines into one process and looks at the words.
"""

from __future__ import annotations

import contextlib
import io
import os
import resource
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
    ("reprint sheet.pdf --run run --n 12 --sessions 6 --out photos", 0),
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
    """In a process of its own, on one core, and the time of it."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    command, env = [sys.executable, "-m", "patchproof", *line.split()], os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        command, cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8"
    )
    return done.returncode, done.stdout, resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def test_a_first_hour_says_at_each_step_what_to_do_next(tmp_path, monkeypatch):
    monkeypatch.setattr("patchproof.optimizer.loop.SELECT_VIEWS", 8)  # what they cost is time
    monkeypatch.setattr("patchproof.optimizer.run.DRAFT_EFFORT", (24, 40))
    monkeypatch.setattr("patchproof.app.begin.sides._STEP_DEG", 90)
    small = "[camera]\nphoto_px = [1040, 780]\n[background]\ncolor = [0.5, 0.5, 0.5]\n"
    said = {line: text for line, (text, _) in spent(tmp_path, typed_here, small).items()}
    asked, new, preview, optimize, sheet, _, refused, verify = said.values()
    assert 'add --label with what it is to be recognized as: "lamp", "vase", "stone"' in asked
    assert "length: 340 mm, by the file's units" in new and "next: patchproof preview scene.toml" in new
    assert '"lamp" first in ' in preview and "next: patchproof optimize scene.toml" in preview
    assert "Draft of" in optimize and "(preliminary): helps" in optimize
    assert "next: patchproof sheet run --out sheet.pdf" in optimize and "sheet.json" in sheet
    assert f"or name the networks yourself (--models '{MODEL}')" in refused
    assert "Helps (controls rendered into these photographs)" in verify and "verdict: kept" in verify
    assert "photographs: 15, judged 13, measured 12" in verify  # 12, two copies and a screenshot
    for named in ("copy: 2", "cropped: 1", "IMG_0007.MOV", "IMG_0008.CR2", "thumbnails"):
        assert named in verify, named
    assert not any(word in verify for word in ("notes.txt", ".DS_Store", "._photo.jpg"))


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        hour = spent(Path(place), typed_apart)
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
