"""Style, checked by the tool that sets it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
WRITTEN = ("src", "tests", "print_templates", ".readme", ".github")
BRITISH = re.compile(
    r"(?:optim|normal|recogn|character|raster|minim|maxim|organ|summar|initial|general|visual|quant)is[ei]|colour"
    r"|centre|centring|neighbour|behaviour|modell|labell|metre|analyse(?!s\b)|analysing|favour|artefact|grey",
    re.IGNORECASE,
)
# names of others
THEIRS = re.compile(r"colour-science|\bcolour(?:\.\w+| = pytest)|RGB_COLOURSPACES|\"colour\"")


@pytest.mark.parametrize("arguments", [("check",), ("format", "--check")])
def test_ruff_has_nothing_to_say(arguments):
    command = [sys.executable, "-m", "ruff", *arguments, "--no-cache", str(ROOT / "src"), str(ROOT / "tests")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_dependency_says_what_it_is_for():
    lines = (ROOT / "pyproject.toml").read_text(encoding="utf-8").splitlines()
    named = [line for line in lines if line.startswith('    "') and any(sign in line for sign in (">=", "=="))]
    assert len(named) > 15 and all("#" in line for line in named)


def british(text: str) -> list[str]:
    """The words that are spelled so, each once."""
    words = dict.fromkeys(re.findall(r"\w+", THEIRS.sub("", text)))
    return [word for word in words if BRITISH.search(word)]


def test_the_speller_sees_words_and_lets_names_pass():
    assert british("Optimise the colours of a grey centre, 3 millimetres wide: `test_neighbours`") == [
        "Optimise",
        "colours",
        "grey",
        "centre",
        "millimetres",
        "test_neighbours",
    ]
    fine = "analyses; parameter; center; noise; raster; organism; minimum; quantity"
    assert not british('colour = pytest.importorskip("colour"); colour.delta_E')
    assert not british(fine)


def test_spelling_is_american():
    inside = [path for folder in WRITTEN for path in (ROOT / folder).rglob("*")]
    kinds = {".py", ".md", ".toml", ".j2"}
    files = [path for path in [*ROOT.glob("*"), *inside] if path.suffix in kinds and path != Path(__file__)]
    assert len(files) > 200
    found = {str(path.relative_to(ROOT)): british(path.read_text(encoding="utf-8")) for path in files}
    assert not {name: words for name, words in found.items() if words}
