"""What a print shop is told is read from the PDF: each statement turns into a problem where the file is another."""

import io
import re

import pikepdf
import pytest
from pikepdf import Array, Name
from PIL import Image

from patchproof.base.errors import Refused
from patchproof.sheets.print_advice import pdf_advice
from test_photo_page_code import sheet


@pytest.fixture(scope="module")
def pdf_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("shop") / "sheet.pdf"
    sheet(path)
    return path


def unembed(pdf):
    for font in pdf.pages[0].resources.Font.values():
        del font.FontDescriptor["/FontFile2"]


def jpeg(pdf):
    buffer = io.BytesIO()
    Image.new("RGB", (128, 128)).save(buffer, "JPEG")
    (image,) = pdf.pages[0].resources.XObject.values()
    image.write(buffer.getvalue(), filter=Name.DCTDecode)


def untagged(pdf):
    (image,) = pdf.pages[0].resources.XObject.values()
    image.ColorSpace = Name.DeviceRGB


def no_default(pdf):
    del pdf.pages[0].resources.ColorSpace["/DefaultRGB"]


def scaled(pdf):
    del pdf.Root.ViewerPreferences["/PrintScaling"]


def trimmed(pdf):
    pdf.pages[0].obj.TrimBox = Array([10, 10, 500, 700])


def boxless(pdf):
    del pdf.pages[0].obj["/BleedBox"]


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (unembed, "not embedded: BitstreamVeraSans-Bold, BitstreamVeraSans-Roman"),
        (jpeg, r"lossy \(/DCTDecode\)"),
        (untagged, "no ICC profile"),
        (no_default, "device RGB without a profile"),
        (scaled, "PrintScaling None is missing"),
        (trimmed, "differ from the page"),
        (boxless, "no trim and bleed box"),
    ],
)
def test_every_fault_is_found_in_the_file(pdf_path, tmp_path, spoil, problem):
    assert not any("PROBLEM" in line for line in pdf_advice(pdf_path))
    with pikepdf.open(pdf_path) as pdf:
        spoil(pdf)
        pdf.save(tmp_path / "spoiled.pdf")
    (line,) = (line for line in pdf_advice(tmp_path / "spoiled.pdf") if "PROBLEM" in line)

    assert re.search(problem, line)


def test_resolution_is_that_of_the_drawn_size(pdf_path):
    (line,) = (line for line in pdf_advice(pdf_path) if "ppi" in line)
    assert "140 × 140 pixels on 136.0 × 136.0 mm, 26 ppi; lossless" in line  # 140 / 136 × 25.4 = 26.1


def test_what_is_no_pdf_is_refused(tmp_path):
    (tmp_path / "a.pdf").write_text("no")
    with pytest.raises(Refused, match="Expected a PDF of a sheet"):
        pdf_advice(tmp_path / "a.pdf")
