"""The page stands alone, says what the report says, and has the same bytes each time."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html.parser import HTMLParser

import numpy as np
import pytest

from patchproof.report.images import delta_map
from patchproof.report.write import write_report
from patchproof.verify.results import PhotoEntry, Prediction, Report, Summary
from test_photo_synthetic import make_manifest
from test_verify_run import promise


def some_report(verdict="kept"):
    seen = Prediction(label="<b>bright</b>", confidence=0.8, target_confidence=0.8, recognized=True)
    photos = [
        PhotoEntry(
            file=f"p{i}.jpg", status="measured", markers_found=8, residual_mm=0.02, px_per_mm=1.0 + i, tilt_deg=5.0 * i,
            contrast=0.7, blur_px=0.6, corner_uncertainty_mm=0.05, delta_e00_mean=2.0, delta_e00_p95=4.0,
            color_fit="affine12", predictions={"net": seen},
        )
        for i in range(3)
    ]  # fmt: skip
    photos.append(PhotoEntry(file="bad.jpg", status="rejected", code="unreadable", advice="copy it again"))
    summary = Summary(
        photos=4, judged=3, measured=3, rate=1.0, interval=(0.44, 1.0), prediction_interval=(2, 3), verdict=verdict,
        effect="not_tested", matched_rate=None,
    )  # fmt: skip
    return Report(sheet_id="TESTSHEET0", photos=tuple(photos), summary=summary)


def pictures():
    flat = np.full((40, 60, 3), 90, np.uint8)
    kinds = {"photo": flat, "seen": flat, "fitted": flat, "promised": flat, "delta_e00": np.full((6, 6), 3.0)}
    return {"p0.jpg": kinds}


def written(out, verdict="kept"):
    rest = dict(azimuth_deg=None, contrast=None, blur_px=None, recognized=True)
    claims = [dict(px_per_mm=1.0 + i % 3, tilt_deg=float(i), **rest) for i in range(30)]
    manifest = make_manifest(promise(claims)).model_dump(mode="json")
    notes = {"reason": "3 of 3 photographs were recognized.", "controls": []}
    return write_report(some_report(verdict).model_dump(), manifest, pictures(), out, notes)


class Tags(HTMLParser):
    def __init__(self):
        super().__init__()
        self.links, self.open, self.kinds = [], [], set()

    def handle_starttag(self, tag, attrs):
        self.kinds.add(tag)
        self.links += [value for name, value in attrs if name in {"src", "href", "xlink:href"}]


def test_the_page_asks_nothing_of_the_network_and_runs_no_script(tmp_path):
    text = written(tmp_path).read_text()
    tags = Tags()
    tags.feed(text)
    assert tags.links and all(link.startswith(("data:image/", "#")) for link in tags.links)
    assert not tags.kinds & {"script", "link", "iframe"}
    assert not re.search(r"url\((?!#)|@import", text)


def test_the_page_says_what_the_report_says_and_escapes_it(tmp_path):
    text = written(tmp_path).read_text()
    for words in (
        "Promise kept",
        "TESTSHEET0",
        "p2.jpg",
        "unreadable",
        "copy it again",
        "&lt;b&gt;bright",
        "not measured",
    ):
        assert words in text
    assert "<b>bright" not in text and "Promise broken" not in text
    assert text.count("<svg") == 2


def test_json_is_the_report_and_nothing_else(tmp_path):
    written(tmp_path)
    assert json.loads((tmp_path / "report.json").read_text()) == json.loads(some_report().dump())
    assert (tmp_path / "report.json").read_text() == some_report().dump()
    assert sorted(p.name for p in (tmp_path / "pictures").iterdir())[0] == "p0.jpg.delta_e00.png"


def test_the_same_report_has_the_same_bytes(tmp_path):
    assert written(tmp_path / "a").read_bytes() == written(tmp_path / "b").read_bytes()


def test_a_sheet_without_a_promise_has_a_page_too(tmp_path):
    summary = Summary(
        photos=0, judged=0, measured=0, rate=None, interval=None, prediction_interval=None, verdict="cannot_tell",
        effect="not_tested", matched_rate=None,
    )  # fmt: skip
    report = Report(sheet_id="TESTSHEET0", photos=(), summary=summary)
    page = write_report(report.model_dump(), make_manifest().model_dump(mode="json"), {}, tmp_path)
    assert "Cannot tell" in page.read_text()


def test_difference_maps_have_one_scale_and_show_what_was_not_measured():
    cells = np.array([[0.0, 20.0], [200.0, np.nan]])
    colors = delta_map(cells, 2)
    assert (colors[0, 1] == colors[1, 0]).all() and colors[0, 0].sum() > colors[0, 1].sum()
    assert colors[1, 1, 3] == 0 and colors[0, 0, 3] == 255


def test_a_browser_shows_it_without_scrolling_sideways_on_a_phone(tmp_path):
    browser = shutil.which("chromium") or shutil.which("google-chrome")
    if browser is None:
        pytest.skip("no Chromium here to look at the page")
    page = written(tmp_path)
    probe = page.read_text().replace(
        "</body>", "<script>document.title = 'w' + document.documentElement.scrollWidth</script></body>"
    )
    frame = tmp_path / "frame.html"
    (tmp_path / "probe.html").write_text(probe)
    # a frame of 390 px, since a headless window is never narrower than 500
    frame.write_text(
        "<iframe src='probe.html' width='390' height='800' style='border:0' onload='"
        "document.title = this.contentDocument ? this.contentDocument.title : 0'></iframe>"
    )
    flags = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    flags += (
        f" --disable-component-update --disable-sync --allow-file-access-from-files --user-data-dir={tmp_path / 'u'}"
    )
    done = subprocess.run([browser, *flags.split(), "--dump-dom", frame.as_uri()], capture_output=True, timeout=60)
    width = re.search(r"<title>w(\d+)</title>", done.stdout.decode())
    assert width is not None and int(width[1]) <= 390
