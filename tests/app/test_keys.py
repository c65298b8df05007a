"""The page of all keys is what the settings classes say, and says all of it."""

from __future__ import annotations

import re
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
from console import lab_command

import patchlab
import patchproof
from patchlab.keys import HEAD, documents
from patchproof.app.keys import DOCUMENTS, codes_table, files_page, keys_page, meanings, tables
from patchproof.base.errors import Refused
from patchproof.base.validation import StrictModel
from patchproof.sheets.template import QrCode

ROOT = Path(__file__).resolve().parents[2]


@cache
def every() -> dict[str, tuple]:
    """All documents, with the laboratory's."""
    return {**DOCUMENTS, **documents()}


def models() -> set[type[StrictModel]]:
    return {model for _, settings in every().values() for _, model in tables(settings)}


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    """All pages, as they are printed."""
    return {"keys": keys_page(DOCUMENTS), "lab_keys": keys_page(documents(), head=HEAD), "files": files_page()}


def test_the_stored_page_is_what_is_printed(pages):
    for page, printed in pages.items():
        stored = (ROOT / f".readme/{page}.md").read_text(encoding="utf-8")
        assert stored == printed, f"print {page}.md again: patchproof keys [--files], patchlab keys"


def test_the_questions_end_with_every_code():
    stored = (ROOT / ".readme/faq.md").read_text(encoding="utf-8")
    assert stored.endswith(codes_table()), "print the table again: patchproof keys --codes"


def test_every_key_says_what_it_means():
    silent = [
        f"{model.__name__}.{key}"
        for model in models()
        for key, field in model.model_fields.items()
        if key not in meanings(model)
        and not (isinstance(field.annotation, type) and issubclass(field.annotation, StrictModel))  # has its own table
    ]
    assert not silent, "add a comment at the end of the line, or above it"


def test_every_settings_class_is_on_the_page():
    covered, found = models(), 0
    sources = [Path(package.__file__).parent for package in (patchproof, patchlab)]
    for path in (path for source in sources for path in source.rglob("*.py") if "results" not in path.parts):
        module = ".".join(path.relative_to(ROOT / "src").with_suffix("").parts)
        for name in re.findall(r"(?m)^class (\w*(?:Settings|Template))\b", path.read_text(encoding="utf-8")):
            settings, found = getattr(import_module(module), name), found + 1
            assert any(issubclass(model, settings) for model in covered), f"{module}.{name}"
    assert found > 20


def test_meanings_stand_beside_fields_or_above_them():
    assert meanings(QrCode)["size_mm"] == "its side, without the quiet zone"
    scene = every()["scene"][1]
    view, camera = scene.model_fields["view"].annotation, scene.model_fields["camera"].annotation
    assert meanings(view)["roll_deg"] == "of the camera about its axis"
    assert meanings(camera)["photo_px"] == "Width and height of a whole photograph."  # above
    inherited = meanings(every()["transfer"][1])
    assert inherited["networks"] == "networks to train on and to test" and "lights" in inherited


@pytest.mark.parametrize(
    "row",
    [
        "| `length_mm` | number, > 0 | mm | none | a mesh's longest extent |",
        '| `up` | `"y"`, `"z"` |  | `"z"` | the axis of the mesh file that points up |',
        "| `elevation_deg` | [low, high], -89 to 89 | ° | `[2, 27]` | of the camera above the horizontal |",
        "| `white_balance` | number, 0 to 0.5 |  | `0.05` | largest error of the red and of the blue gain |",
        "| `photo_px` | [2 integers, 64 to 20000] | px | `[1600, 1200]` | Width and height of a whole photograph. |",
        "| `corners_mm` | list of [2 numbers], 2 or more | mm | required | top-left, one per marker |",
        "| `swatch_mm` | number, ≥ 4 | mm | required | side; below 4 a phone's photograph of the page has too few "
        "pixels |",
        "| `views` | table of [low, high] |  | `{}` | Ranges of azimuth in degrees, by name; by default thirds of each "
        "scene's range. |",
    ],
)
def test_rows(row, pages):
    assert any(row in page.splitlines() for page in pages.values())


def test_one_kind_of_file_is_printed_alone(capsys):
    assert lab_command("keys", "promises") == 0
    printed = capsys.readouterr().out
    assert printed.startswith("## promises\n") and "`path_traced`" in printed and "## scene" not in printed
    with pytest.raises(Refused, match='did you mean "promises"'):
        keys_page(documents(), "promise")


def test_the_help_of_study_names_every_study(capsys):
    assert lab_command("study", "--help") == 0
    printed = capsys.readouterr().out
    assert "  promises   Check that promised rates hold" in printed and "patchlab keys NAME" in printed
