"""Shipped data is found in an installed wheel and in an editable checkout, each in an environment of its own."""

from __future__ import annotations

import shutil
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOUND = (
    "from patchproof.base.packaged import packaged_path as at; import patchproof, sys\n"
    "print(at('calibration', 'printers', 'coated.npz').resolve(), at('print_templates', 'a4.toml').resolve())"
)


@pytest.fixture(scope="module")
def checkout(tmp_path_factory) -> Path:
    """A copy of what is in the repository, without anything built."""
    copy = tmp_path_factory.mktemp("checkout")
    for name in ("src", "calibration", "print_templates", "pyproject.toml", "README.md", "LICENSE"):
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, copy / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, copy / name)
    return copy


def environment(folder: Path) -> Path:
    """A new environment that borrows the libraries of this one, but not an installed patchproof."""
    venv.create(folder, with_pip=False)
    python = folder / "bin" / "python"
    site = subprocess.check_output([python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"], text=True)
    borrowed = Path(sysconfig.get_path("purelib"))
    (Path(site.strip()) / "borrowed.pth").write_text(f"{borrowed}\n")
    return python


def pip(python: Path, *arguments: str) -> None:
    command = [sys.executable, "-m", "pip", "--python", str(python), "install", "--no-deps", "--no-build-isolation"]
    subprocess.run([*command, "--quiet", "--no-index", *arguments], check=True, capture_output=True)


def test_a_wheel_carries_its_data(checkout, tmp_path):
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(tmp_path), str(checkout)]
    subprocess.run(command, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    for name in (
        "calibration/printers/coated.npz",
        "print_templates/a4.toml",
        "classifier/builtin.safetensors",
        "py.typed",
    ):
        assert f"patchproof/{name}" in names
    assert any(name.endswith("page.html.j2") for name in names)
    python = environment(tmp_path / "env")
    pip(python, str(wheel))
    for place in subprocess.check_output([python, "-I", "-c", FOUND], text=True, cwd=tmp_path).split():
        assert Path(place).is_file() and str(tmp_path / "env") in place


def test_an_editable_checkout_finds_its_data(checkout, tmp_path):
    python = environment(tmp_path / "env")
    pip(python, "--editable", str(checkout))
    for place in subprocess.check_output([python, "-I", "-c", FOUND], text=True, cwd=tmp_path).split():
        assert Path(place).is_file()
    (checkout / "print_templates" / "new.toml").write_text("x = 1")
    code = (
        "from patchproof.base.packaged import packaged_path as at; print(at('print_templates', 'new.toml').is_file())"
    )
    assert subprocess.check_output([python, "-I", "-c", code], text=True, cwd=tmp_path).strip() == "True"
