"""A sheet's PDF from somebody else is drawn within bounds of memory and time, whatever it holds."""

from __future__ import annotations

import signal
import sys
import time
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pikepdf
import pytest
from fuzz.pdf_bombs import PDF_BOMBS
from fuzz.watch import peak_bytes

from patchproof.base import input as bounds
from patchproof.base.declarations import load_declarations
from patchproof.base.errors import Refused
from patchproof.sheets import pdf_raster
from patchproof.sheets.blank import blank_sheet
from patchproof.sheets.manifest import Manifest
from patchproof.sheets.pdf_raster import attached_manifests, rasterize_page

needs_timer = pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="there are no such timers on Windows")


def test_a_page_of_too_many_pixels_is_refused_before_memory_is_taken(tmp_path, monkeypatch):
    page = tmp_path / "s.pdf"
    blank_sheet("blank_a4", page)
    width, height = rasterize_page(page, 1, 30).shape[1::-1]
    monkeypatch.setattr(pdf_raster, "MAX_PAGE_PX", width * height)
    assert rasterize_page(page, 1, 30).shape == (height, width, 3)
    monkeypatch.setattr(pdf_raster, "MAX_PAGE_PX", width * height - 1)
    with pytest.raises(Refused, match=rf"million in total, got {width} × {height}: lower"):
        rasterize_page(page, 1, 30)


def forms_in_forms(path: Path, levels: int) -> None:
    """A page on which a rectangle is drawn ten to the power of so many levels times."""
    pdf = pikepdf.new()
    page = pdf.add_blank_page(page_size=(200, 200))
    form = {"Type": pikepdf.Name.XObject, "Subtype": pikepdf.Name.Form, "BBox": [0, 0, 200, 200]}
    inner = pdf.make_stream(b"0 0 1 rg 1 1 90 90 re f", **form)
    for _ in range(levels):
        resources = pikepdf.Dictionary(XObject=pikepdf.Dictionary(F=inner))
        inner = pdf.make_stream(b"/F Do " * 10, Resources=resources, **form)
    page.Contents = pdf.make_stream(b"/F Do")
    page.Resources = pikepdf.Dictionary(XObject=pikepdf.Dictionary(F=inner))
    pdf.save(path)


@needs_timer
def test_a_page_that_takes_too_long_is_refused(tmp_path, monkeypatch):
    """Five levels take 1 s, and nothing interrupts PDFium but the system, which ends its process."""
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 0.3)
    forms_in_forms(tmp_path / "few.pdf", 3)
    blue = rasterize_page(tmp_path / "few.pdf", 1, 72)
    assert (blue[150, 50] == [0, 0, 255]).all()
    forms_in_forms(tmp_path / "many.pdf", 5)
    before = time.process_time()
    with pytest.raises(
        Refused, match=r"a page that can be drawn in time and memory, got .*, which takes more than 0\.3 s of processor"
    ):
        rasterize_page(tmp_path / "many.pdf", 1, 72)
    assert time.process_time() - before < 0.7
    monkeypatch.setattr(bounds, "TIME_LIMIT_S", 10.0)
    assert (rasterize_page(tmp_path / "few.pdf", 1, 72) == blue).all()


@pytest.mark.skipif(sys.platform != "linux", reason="memory is limited on Linux")
@pytest.mark.parametrize("bomb", ["object stream", "attachment"])
def test_kilobytes_that_unpack_to_gigabytes_are_refused_by_every_reader_of_pdfs(bomb, tmp_path, monkeypatch):
    """In a process whose memory is limited: 3 GB from 5 kB took this one 4 GB, in PDFium as in qpdf."""
    monkeypatch.setattr(bounds, "MAX_CHILD_BYTES", 60_000_000)
    (tmp_path / "bomb.pdf").write_bytes(PDF_BOMBS[bomb]())
    before = peak_bytes(reset=True)
    with pytest.raises(Refused):
        (rasterize_page if bomb == "object stream" else attached_manifests)(tmp_path / "bomb.pdf")
    assert peak_bytes() - before < 50_000_000


@cache
def one_sheet(suffix: str) -> bytes:
    with TemporaryDirectory() as folder:
        blank_sheet("blank_a4", Path(folder) / "s.pdf")
        return (Path(folder) / f"s.{suffix}").read_bytes()


def declaring(path: Path, **entries) -> Path:
    """A small sheet whose first page declares something."""
    path.write_bytes(one_sheet("pdf"))
    with pikepdf.open(path, allow_overwriting_input=True) as pdf:
        for name, value in entries.items():
            pdf.pages[0][f"/{name}"] = pikepdf.Array(value) if isinstance(value, list) else value
        pdf.save(path)
    return path


def is_refused(path: Path) -> bool:
    """True if the first page, or the manifest in the file, is not read."""
    try:
        attached_manifests(path)[0]
        rasterize_page(path, 1, 20)
    except Refused:
        return True
    return False


def with_password(path: Path) -> Path:
    with pikepdf.open(declaring(path), allow_overwriting_input=True) as pdf:
        pdf.save(path, encryption=pikepdf.Encryption(owner="a", user="b"))
    return path


def shifted(path: Path) -> bool:
    """True if a page whose corner lies elsewhere shows the same pixels."""
    right = rasterize_page(declaring(path), 1, 20)
    with pikepdf.open(path, allow_overwriting_input=True) as pdf:
        page = pdf.pages[0]
        x, y, right_end, top = (float(value) for value in page.mediabox)
        page.contents_add(b"1 0 0 1 30 20 cm", prepend=True)
        for box in [name for name in page.keys() if name.endswith("Box")]:
            page[box] = [x + 30, y + 20, right_end + 30, top + 20]
        pdf.save(path)
    return bool(np.abs(rasterize_page(path, 1, 20).astype(int) - right).mean() < 0.5)


def inheriting(path: Path, **boxes: list[int]) -> Path:
    """A PDF whose pages have these boxes from the list of pages, as far as they have none of their own."""
    with pikepdf.open(declaring(path), allow_overwriting_input=True) as pdf:
        for name, box in boxes.items():
            pdf.Root.Pages[f"/{name}"] = pikepdf.Array(box)
            for page in pdf.pages:
                if f"/{name}" in page:
                    del page[f"/{name}"]
        pdf.save(path)
    return path


def more_pages(path: Path) -> bool:
    before = attached_manifests(declaring(path))[0]
    with pikepdf.open(path, allow_overwriting_input=True) as pdf:
        pdf.add_blank_page()
        pdf.save(path)
    return attached_manifests(path)[0] == before and not is_refused(path)


CASES = {  # by what is declared: True if the answer is that of the list
    "attached manifest": lambda path: (
        attached_manifests(declaring(path))[0] == Manifest.model_validate_json(one_sheet("json"))
    ),
    "pages": more_pages,
    "MediaBox": shifted,
    "CropBox other than the MediaBox": lambda path: is_refused(declaring(path, CropBox=[9, 9, 300, 300])),
    "Rotate": lambda path: is_refused(declaring(path, Rotate=90)),
    "UserUnit": lambda path: is_refused(declaring(path, UserUnit=2)),
    "a password": lambda path: is_refused(with_password(path)),
}


def test_boxes_that_pages_inherit_are_used_as_their_own(tmp_path):
    assert is_refused(inheriting(tmp_path / "s.pdf", CropBox=[9, 9, 300, 300]))
    boxes = {name: [-72, -36, 500, 700] for name in ("MediaBox", "CropBox")}
    paths = inheriting(tmp_path / "t.pdf", **boxes), declaring(tmp_path / "u.pdf", **boxes)
    inherited, own = (rasterize_page(path, 1, 20) for path in paths)
    assert np.array_equal(inherited, own)


@pytest.mark.parametrize("entry", load_declarations("sheets"), ids=lambda entry: entry.declares)
def test_what_a_pdf_declares_is_used_or_refused(entry, tmp_path):
    assert CASES[entry.declares](tmp_path / "s.pdf")
