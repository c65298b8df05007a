"""Text from files: in which encodings it is read, and that it neither moves a cursor nor computes anything."""

from __future__ import annotations

import warnings

import pytest

from patchproof.base.csv_file import csv_lines, read_csv
from patchproof.base.declarations import load_declarations
from patchproof.base.errors import Refused
from patchproof.base.input import read_json
from patchproof.base.text import printable
from patchproof.base.validation import StrictModel, read_toml, validate_model
from patchproof.report.page import draw_figure, render_page
from patchproof.sheets.layout import drawable_text

TOML, JSON = 'label = "é"\n', '{"label": "é"}'


class Named(StrictModel):
    label: str


def read_all(folder, encode):
    """What the readers of TOML, JSON and CSV say of files in an encoding."""
    said = []
    for name, text in (("a.toml", TOML), ("a.json", JSON), ("a.csv", "file,label\nx,é\n")):
        (folder / name).write_bytes(encode(text))
        try:
            if name == "a.csv":
                said.append(read_csv(folder / name, "a CSV")[1][1])
            else:
                data = read_toml(folder / name) if name == "a.toml" else read_json(folder / name, "JSON", "mend it")
                said.append(validate_model(Named, data, name).label)
        except Refused as error:
            said.append(str(error))
    return said


def separated(separator):
    def read(folder):
        (folder / "a.csv").write_text(
            f"a.png{separator}cat, tabby\nb.png{separator}dog\nc, d, e.png{separator}dog\n", encoding="utf-8"
        )
        with pytest.raises(Refused) as error:
            read_csv(folder / "a.csv", "a CSV")
        return [str(error.value)]

    return read


def test_a_quote_that_never_ends_swallows_no_rows(tmp_path):
    (tmp_path / "a.csv").write_text('a.png,cat\nb.png,"bus\nc.png,dog\n', encoding="utf-8")
    with pytest.raises(Refused, match=r"a\.csv that cannot be read"):
        read_csv(tmp_path / "a.csv", "a CSV")


def formula(folder):
    (folder / "a.csv").write_text(csv_lines([("a", "=1+1"), ("b", "'x")]), encoding="utf-8")
    return ["é"] * (read_csv(folder / "a.csv", "a CSV") == [["a", "=1+1"], ["b", "'x"]])


def encodings(*codecs):
    return lambda folder: [
        said for codec in codecs for said in read_all(folder, lambda text, codec=codec: text.encode(codec))
    ]


CASES = {
    "UTF-8, with or without a byte order mark": (encodings("utf-8", "utf-8-sig"), "é"),
    "UTF-16, with or without a byte order mark": (encodings("utf-16", "utf-16-le", "utf-16-be"), "in UTF-16: save it"),
    "bytes that are not UTF-8, such as Latin-1": (encodings("latin-1"), '0xe9 ("é" in Latin-1): save it as UTF-8'),
    "an unknown key of settings": (
        lambda folder: read_all(folder, lambda text: text.replace("label", "lable").encode())[:2],
        'did you mean "label"',
    ),
    "semicolons or tabs as separators": (lambda f: separated(";")(f) + separated("\t")(f), ": save it with commas"),
    "an apostrophe before a formula": (formula, "é"),
}


@pytest.mark.parametrize("entry", load_declarations("base"), ids=lambda entry: entry.declares)
def test_what_text_files_declare_is_used_or_refused(tmp_path, entry):
    read, outcome = CASES[entry.declares]
    said = read(tmp_path)
    assert said and all(text == outcome if entry.answer == "used" else outcome in text for text in said), said


def test_text_from_files_moves_no_cursor_and_turns_no_line():
    hostile = "a\x1b[31m\r\nb\u202egpj\u2028\udcff\x85"
    safe = r"a\x1b[31m\r\nb\u202egpj\u2028\udcff\x85"
    assert printable(hostile) == safe
    assert printable("Lkw é 卡车 شاحنة 👩‍🚒") == "Lkw é 卡车 شاحنة 👩‍🚒"
    refused = str(Refused("a folder", hostile, "go on"))
    assert refused.isprintable() and r"\x1b[31m" in refused and r"\u202e" in refused


def test_no_cell_of_a_csv_is_a_formula():
    starts = ("=", "+", "-", "@", "\t", "\r", "\n", " =", "＝", "＋", "－", "＠")
    for line, start in zip(csv_lines([start + "1"] for start in starts).splitlines(), starts, strict=True):
        assert line.startswith("'"), start
    assert csv_lines([(-1.5, "a-b", None, True)]) == "-1.5,a-b,,True\n"


def test_pages_show_control_characters_as_text(tmp_path):
    (tmp_path / "p.html").write_text("<p>{{ name }}</p>{{ svg | safe }}", encoding="utf-8")
    page = render_page("p.html", tmp_path, name="<b>\x1b\u202e\nnext", svg="<svg>\x1b</svg>")
    assert page == "<p>&lt;b&gt;\\x1b\\u202e\nnext</p><svg>\x1b</svg>"


def test_figures_and_sheets_draw_names_in_any_script_and_no_formulas():
    names = ["卡车", "🚚 $\\frac{x$", "$x^2$ Ж", "\x1b[31m", "a\xa0b"]

    def draw(figure):
        axes = figure.add_subplot()
        axes.barh(range(5), range(5))
        axes.set_yticks(range(5), names)
        axes.set_title(names[1])

    with warnings.catch_warnings(action="error"):
        svg = draw_figure(draw, (4, 2), "svg").decode()
    shown = [line for line in svg.splitlines() if "<text" in line]
    assert any("$x^2$ Ж" in line for line in shown) and any(r"\x1b[31m" in line for line in shown)
    assert any(r"$\frac{x$" in line for line in shown)
    assert any("卡车" in line or r"\u5361\u8f66" in line for line in shown)  # as the machine has fonts
    assert any("a\xa0b" in line for line in shown)
    assert drawable_text("design · 卡车", bold=True) == r"design · \u5361\u8f66"
