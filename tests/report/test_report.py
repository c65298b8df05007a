"""The page stands alone, says what the report says, and has the same bytes each time."""

from __future__ import annotations

import base64
import csv
import io
import json
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from browser import Browser
from synthetic_photos import make_manifest

from patchproof.base.intervals import Estimate
from patchproof.evidence.results import (
    Benefit,
    Control,
    Ledger,
    LedgerShare,
    ModelRate,
    Origin,
    PhotoEntry,
    Prediction,
    Remark,
    Report,
    SessionCount,
    Summary,
)
from patchproof.report.page import delta_map, draw_figure, save_pictures
from patchproof.report.tables import Drawing, Results, Table, write_results
from patchproof.report.words import verdict_lines
from patchproof.report.write import photos_csv, rates_by_band, report_html, write_report
from test_verify_run import promise


def some_report(verdict="kept"):
    seen = Prediction(label="<b>bright</b>", confidence=0.8, target_confidence=0.8, recognized=True)
    photos = [
        PhotoEntry(
            file=f"p{i}.jpg", status="measured", markers_found=8, residual_mm=0.02, px_per_mm=1.0 + i, tilt_deg=5.0 * i,
            contrast=0.7, blur_px=0.6, corner_uncertainty_mm=0.05, delta_e00_mean=2.0, delta_e00_p95=4.0,
            color_fit="affine12", clipped_share=0.0, glossy_share=0.0,
            predictions={"net": seen}, sha256="f" * 64, scale_x=0.97, scale_y=0.971 + i / 1000,
        )
        for i in range(3)
    ]  # fmt: skip
    photos.append(
        PhotoEntry(file="bad.jpg", status="rejected", code="unreadable", advice="copy it again", said=["more pages"])
    )
    summary = Summary(
        photos=4, judged=3, measured=3, rate=1.0, interval=(0.44, 1.0), prediction_interval=(2, 3), verdict=verdict,
        reason="3 of 3 photographs were recognized.",
        ledger=some_ledger(),
        worth=Benefit(word="helps", goal="assist", source="photographed", photos=3, rate=1.0, interval=(0.44, 1.0),
                      control="gray", control_rate=1 / 3, control_interval=(0.06, 0.79), difference=0.67,
                      difference_interval=(0.1, 0.9)),
    )  # fmt: skip
    origin = Origin(
        options={"ruler_mm": (97.1, 97.3)},
        sha256={"network net": "e" * 64},
        versions={"numpy": "1"},
        notes=("it is odd",),
    )
    controls = (Control("gray", 1, 3, (0.06, 0.79), 3, 0.67, (0.1, 0.9), 2, "", False, (1.0, 0.333)),)
    return Report(sheet_id="TESTSHEET0", photos=tuple(photos), summary=summary, controls=controls, origin=origin)


def some_ledger():
    steps = ("gamut", "print", "light_and_camera", "blur_and_noise", "photo")
    shares = {
        step: LedgerShare(share=share, interval=(share - 0.02, share + 0.02))
        for step, share in zip(steps, (0.01, 0.2, 0.05, -0.02, 0.03), strict=True)
    }
    return Ledger(shares=shares, ideal=0.9, photo=0.63, photos=12, culprit="print")


def pictures():
    flat = np.full((40, 60, 3), 90, np.uint8)
    kinds = {"photo": flat, "seen": flat, "fitted": flat, "promised": flat, "delta_e00": np.full((6, 6), 3.0)}
    return {"p0.jpg": kinds}


def written(out, verdict="kept"):
    """The page of a report that is written into `out`."""
    rest = dict(azimuth_deg=None, contrast=None, blur_px=None, recognized=True)
    claims = [dict(px_per_mm=1.0 + i % 3, tilt_deg=float(i), **rest) for i in range(30)]
    manifest = make_manifest(promise(claims)).model_dump(mode="json")
    for file, kinds in pictures().items():
        save_pictures(out / "pictures", file, kinds)
    return write_report(some_report(verdict).model_dump(mode="json"), manifest, out)


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A page to look at, beside the other files."""
    return written(tmp_path_factory.mktemp("report"))


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.links, self.open, self.kinds = [], [], set()

    def handle_starttag(self, tag, attrs):
        self.kinds.add(tag)
        self.links += [value for name, value in attrs if name in {"src", "href", "xlink:href"}]


def test_the_page_asks_nothing_of_the_network_and_runs_no_script(shown):
    text = shown.read_text()
    tags = Tags()
    tags.feed(text)
    assert tags.links and all(link.startswith(("data:image/", "#")) for link in tags.links)
    assert not tags.kinds & {"script", "link", "iframe"}
    assert not re.search(r"url\((?!#)|@import", text)


def test_the_page_says_what_the_report_says_and_escapes_it(shown):
    text = shown.read_text()
    for words in (
        "Promise kept",
        "TESTSHEET0",
        "p2.jpg",
        "unreadable",
        "copy it again",
        "Left out: more pages.",
        "&lt;b&gt;bright",
        "not measured",
        "3 of 3 photographs were recognized.",
        "97.1, 97.3",
        "e" * 64,
        "f" * 64,
        "numpy 1",
        "it is odd.",
        "+66.7 points",
    ):
        assert words in text
    assert "<b>bright" not in text and "Promise broken" not in text
    assert "<svg" not in text and "where confidence is lost" in text.casefold()


def test_an_answer_about_a_photograph_that_does_not_count_is_not_called_recognized(tmp_path):
    report = some_report()
    rejected = report.photos[-1].changed(predictions=report.photos[0].predictions)
    manifest = make_manifest(promise()).model_dump(mode="json")
    words = "<br>recognized", "<br>not counted"
    for photos, word in ((report.photos[:1], words[0]), ((rejected,), words[1])):
        write_report(report.changed(photos=photos).model_dump(mode="json"), manifest, tmp_path)
        page = (tmp_path / "report.html").read_text("utf-8")
        assert [each for each in words if each in page] == [word]


def test_json_is_the_report_and_nothing_else(shown):
    folder = shown.parent
    assert json.loads((folder / "report.json").read_text()) == some_report().model_dump(mode="json")
    again = Report.model_validate_json((folder / "report.json").read_text())
    assert again.photos == some_report().photos and again.model_dump_json() == some_report().model_dump_json()
    assert sorted(p.name for p in (folder / "pictures").iterdir())[0] == "p0.jpg.delta_e00.png"


def test_csv_has_a_row_for_each_photograph_and_all_of_its_figures(shown):
    rows = list(csv.DictReader(io.StringIO((shown.parent / "report.csv").read_text(encoding="utf-8"))))
    photos = some_report().photos
    assert [row["file"] for row in rows] == [photo.file for photo in photos]
    assert (
        float(rows[2]["scale_y"]) == photos[2].scale.scale_y
        and rows[3]["scale_y"] == ""
        and rows[3]["code"] == "unreadable"
    )
    assert rows[0]["net label"] == "<b>bright</b>" and float(rows[0]["net confidence"]) == 0.8
    names = photos[0].model_dump().keys() - {"said"} - {"homography_px_from_mm", "predictions"}
    assert (
        names <= rows[0].keys()
        and {f"homography_px_from_mm_{i}{j}" for i in range(3) for j in range(3)} <= rows[0].keys()
    )


def test_csv_holds_no_formula():
    entry = some_report().photos[0].model_dump(mode="json")
    entry |= {"file": "=1+1.jpg", "homography_px_from_mm": ((1, 2, 3), (4, 5, 6), (7, 8, 9.5))}
    (row,) = csv.DictReader(io.StringIO(photos_csv([entry])))
    assert row["file"] == "'=1+1.jpg" and row["homography_px_from_mm_22"] == "9.5"


def test_the_same_report_has_the_same_bytes(shown, tmp_path):
    assert shown.read_bytes() == written(tmp_path).read_bytes()


def test_a_sheet_without_a_promise_has_a_page_too(tmp_path):
    summary = Summary(
        photos=0, judged=0, measured=0, rate=None, interval=None, prediction_interval=None, verdict="cannot_tell",
    )  # fmt: skip
    report = Report(sheet_id="TESTSHEET0", photos=(), summary=summary)
    page = write_report(report.model_dump(mode="json"), make_manifest().model_dump(mode="json"), tmp_path)
    assert "Cannot tell" in page.read_text()


def test_difference_maps_have_one_scale_and_show_what_was_not_measured():
    cells = np.array([[0.0, 20.0], [200.0, np.nan]])
    colors = delta_map(cells, 2)
    assert (colors[0, 1] == colors[1, 0]).all() and colors[0, 0].sum() > colors[0, 1].sum()
    assert colors[1, 1, 3] == 0 and colors[0, 0, 3] == 255


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with Browser(tmp_path_factory.mktemp("browser")) as browser:
        yield browser


FINE = {"wide": [], "small": 0, "broken": 0, "errors": [], "fetched": []}


@pytest.mark.parametrize("width_px", [390, 1280])
def test_no_page_scrolls_sideways_cuts_anything_or_asks_anybody(shown, browser, tmp_path, width_px):
    for page, images in ((shown, 6), (results_page(tmp_path), 2)):
        seen = browser.look_at(page, width_px)
        assert seen == FINE | {"images": images, "inner": width_px, "width": seen["width"]}
        assert seen["width"] <= width_px


def test_the_browser_sees_what_is_too_wide_fetched_or_in_error(shown, browser, tmp_path):
    page = tmp_path / "report.html"
    bad = "<div style='width:900px'>x</div><img src='gone.png'><script>nothing.at.all</script></main>"
    page.write_text(shown.read_text(encoding="utf-8").replace("</main>", bad), encoding="utf-8")
    seen = browser.look_at(page, 390)
    assert seen["width"] > 390 and seen["wide"] == ["DIV"] and seen["broken"] == 1
    assert len(seen["errors"]) == 1 and len(seen["fetched"]) == 1


@pytest.mark.parametrize("width_px", [390, 1280])
def test_the_first_screen_has_a_picture_with_its_answer_and_both_bars(shown, browser, width_px):
    browser.look_at(shown, width_px)
    parts = "[...document.querySelectorAll('.first .view img, .first .said, .first .bar, .first b')]"
    bottoms = browser.evaluate(parts + ".map(e => e.getBoundingClientRect().bottom)")
    assert len(bottoms) >= 5 and max(bottoms) <= 844
    text = browser.evaluate("document.querySelector('.first').innerText")
    for words in ("80 % · recognized", "44 % to 100 %", "Best control: gray, photographed", "6 % to 79 %", "p0.jpg"):
        assert words in text


class Alternatives(HTMLParser):
    def __init__(self):
        super().__init__()
        self.texts = []

    def handle_starttag(self, tag, attrs):
        if tag == "img":
            self.texts.append(dict(attrs)["alt"])


def results_page(folder):
    """A study's page with two figures of one title, a wide table and a wider one, and a long name."""
    tables = []
    for count in (12, 30):
        row = "/home/somebody/scenes/" * 5, "too_few_markers 1", *[Estimate(-0.512, -0.423, 0.61, 100)] * count
        head = ("object", "said", *(f"recognized {i}" for i in range(count)))
        tables.append(Table(f"cells{count}", "Every cell", head, (row,) * 3))
    figures = [Drawing(name, "Rates", lambda figure: figure.subplots().plot([1, 2])) for name in "ab"]
    write_results(folder, Results("study", "toy", "Toys.", "40 cells", {"key": "a" * 900}, tables, figures, {}, {}))
    return folder / "toy.html"


def test_every_picture_has_words_of_its_own(tmp_path):
    kinds = pictures()["p0.jpg"]
    save_pictures(tmp_path / "pictures", "p1.jpg", kinds)
    for page, count in ((written(tmp_path), 11), (results_page(tmp_path), 2)):
        tags = Alternatives()
        tags.feed(page.read_text())
        assert len(tags.texts) == len(set(tags.texts)) == count and all(tags.texts)


def test_a_table_of_more_rows_than_one_reads_is_folded(tmp_path):
    tables = [Table(f"of{rows}", "Every cell", ("name",), (("car",),) * rows) for rows in (40, 41)]
    write_results(tmp_path, Results("study", "toy", "Toys.", "1 cell", {}, tables, (), {}, {}))
    text = (tmp_path / "toy.html").read_text()
    assert "<summary>41 rows, also in toy_of41.csv</summary>" in text and "40 rows" not in text
    assert (tmp_path / "toy_of41.csv").is_file() and text.count("<details>") == text.count("</details>") == 2


def test_a_figure_for_a_phone_is_narrow_with_panels_one_below_the_other_and_whole_titles(tmp_path):
    def draw(figure):
        for axes in figure.subplots(1, 3, width_ratios=(1, 2, 1)):
            axes.set_title("a title " * 12)
        shown.append(figure)

    shown, drawing = [], Drawing("a", "Rates", draw, (9.0, 3.0))
    for each in (drawing, drawing.for_phone()):
        draw_figure(each.draw, each.size_in, "png")
    (left, *_), column = (figure.axes for figure in shown)
    assert left.get_subplotspec().get_geometry()[:2] == (1, 3)
    assert column[0].get_subplotspec().get_geometry()[:2] == (3, 1) and shown[1].get_figwidth() == 4
    assert all(axes.get_title().count("\n") == 1 for axes in column) and shown[1].get_figheight() > 6
    assert '<source media="(max-width:640px)" srcset="data:image/png' in results_page(tmp_path).read_text()


def test_a_studys_page_begins_with_its_figure(tmp_path):
    text = results_page(tmp_path).read_text()
    assert text.index("<img") < text.index("<table")


def test_a_report_of_fifty_photographs_prints_on_a_few_pages_and_says_a_remark_once(browser, tmp_path):
    report = some_report()
    remark = Remark(code="cropped", advice="use the file of the camera")
    one = report.photos[0].changed(remark=remark, said=["a second page"])
    photos = [one.changed(file=f"{i}.jpg", sha256=f"{i:064x}") for i in range(50)]
    manifest = make_manifest(promise()).model_dump(mode="json")
    page = write_report(report.changed(photos=tuple(photos)).model_dump(mode="json"), manifest, tmp_path)
    text = page.read_text(encoding="utf-8")
    assert text.count("use the file of the camera") == text.count("a second page") == 1
    assert text.count("<code>cropped</code>") == 50
    browser.look_at(page, 1280)
    printed = base64.b64decode(browser.call("Page.printToPDF")["data"])
    assert 2 <= len(re.findall(rb"/Type\s*/Page\b", printed)) <= 6


def test_what_was_not_measured_how_often_was_looked_and_which_folders_are_one_is_said():
    missing, note = {"the scale of the print": "no scan"}, "3 folders look like 2 sessions: a, b"
    sessions = [
        SessionCount(name=n, recognized=1, judged=1, same_as=s) for n, s in (("a", None), ("b", "a"), ("c", None))
    ]
    changes = {"not_measured": missing, "sessions_note": note, "sessions": sessions, "looks": 3}
    report = some_report().changed(summary=some_report().summary.changed(**changes))
    lines = "\n".join(verdict_lines(report))
    for text in ("not measured: the scale of the print (no scan)", "2 sessions", note, "looks: 3, counted in"):
        assert text in lines
    page = report_html(
        report.model_dump(mode="json"),
        {"settings": {}, "promise": None, "design": None, "kind": "blank", "page_mm": (210, 297)},
        {},
    )
    assert "Not measured: the scale of the print (no scan)." in page and note in page


def test_recognition_is_split_by_tilt_and_size_beside_what_was_promised_there():
    """Of 24 photographs the 8 most tilted fail; of the promised views between 16 and 23 degrees, two of eight."""
    photos = [
        {"tilt_deg": i, "px_per_mm": None, "predictions": {"net": {"recognized": i < 16}}} for i in reversed(range(24))
    ]
    promised = [{"tilt_deg": i, "px_per_mm": 1.0, "recognized": i not in (17, 18)} for i in range(30)]
    bands = rates_by_band(photos, "net", promised)
    assert [(name, here.value, there.value) for name, here, there in bands] == [
        ("tilted 0 to 7°", 1, 1), ("tilted 8 to 15°", 1, 1), ("tilted 16 to 23°", 0, 0.75)
    ]  # fmt: skip
    assert all(here.n == there.n == 8 for _, here, there in bands)
    assert rates_by_band(photos[:11], "net", promised) == [] == rates_by_band(photos, "other", promised)
    assert [there for *_, there in rates_by_band(photos, "net", ())] == [None] * 3


def test_networks_that_were_named_stand_below_the_promise_s_own():
    rates = {"builtin": ModelRate(rate=0.5, interval=(0.4, 0.6)), "detector": ModelRate(rate=0.25, interval=(0.1, 0.4))}
    summary = some_report().summary.changed(models=rates)
    lines = verdict_lines(some_report().changed(summary=summary))
    assert "  also detector: 25.0% [10.0%, 40.0%]" in lines and not any("also builtin" in line for line in lines)
