"""Photographs that are one and the same count once; crops, screenshots and what nobody looks at are named."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from synthetic_photos import DESIGN_MM, save, view

from patchproof.base.errors import Refused
from patchproof.evidence import grouping
from patchproof.evidence.grouping import reject_copies
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import Geometry, PhotoEntry
from patchproof.photo.quality import FrameLight
from patchproof.photo.read import list_skipped_files, read_photo
from patchproof.report.words import remarks, verdict_lines
from patchproof.report.write import photos_csv
from test_verify_run import shot, verified

SIZE = (800, 600)


def seen(name, azimuth=10.0, distance=550.0, elevation=5.0, roll=0.0, light=0.8, sha256=None, aside=0.0, flat=True):
    """A measured photograph of the sheet from there, `aside` pixels off its place."""
    matrix = view(azimuth, elevation, distance, roll, SIZE)
    cosine = np.cos(np.radians(azimuth)) * np.cos(np.radians(elevation))
    matrix = np.array([[1, 0, aside], [0, 1, 0], [0, 0, 1]]) @ matrix
    geometry = Geometry(
        residual_mm=0,
        px_per_mm=824 / distance * cosine**0.5,
        tilt_deg=float(np.degrees(np.arccos(cosine))),
        contrast=light,
        blur_px=1,
        corner_uncertainty_mm=0,
        homography_px_from_mm=matrix.tolist() if flat else None,
    )
    entry = PhotoEntry(file=name, status="measured", sha256=sha256, photo_px=SIZE, geometry=geometry)
    return MeasuredPhoto(entry, True, light=FrameLight(np.full(3, light), np.zeros(3), light, 0.0))


@pytest.mark.parametrize(
    ("same", "other"),
    [
        ({"azimuth": 11.0}, {"azimuth": 14.0}),
        ({"roll": 1.0}, {"roll": 1.5}),
        ({"elevation": 6.0}, {"azimuth": -10.0}),  # as much from the other side
        ({"distance": 559.0}, {"distance": 565.0}),
        ({"light": 0.83}, {"light": 0.85, "aside": 2.0}),
        ({"light": 0.4}, {"light": 0.4, "aside": 2.0}),  # an edit, and a camera that was held a little elsewhere
        ({"aside": 7.9, "roll": 0.3}, {"aside": 8.1, "roll": 0.3}),  # a hundredth of 800 px
        ({"aside": 40.0, "roll": 0.2}, {"aside": 40.0, "roll": 0.3}),  # a crop, and a camera that was held elsewhere
        ({"aside": 40.0}, {"aside": 40.0, "distance": 553.0}),
    ],
)
def test_two_shots_of_a_hand_held_camera_are_one_and_another_view_is_none(same, other):
    first = seen("a")
    for how, counted in ((same, False), (other, True)):
        both = reject_copies([first, seen("b", **how)], (0, 0), DESIGN_MM)
        assert both[0] is first and both[1].counted == counted
        assert both[1].entry.code == (None if counted else "copy")
    elsewhere = reject_copies([first, seen("b", **same)], (0, 1), DESIGN_MM)  # in another place and its light
    assert elsewhere[1].counted


def test_a_copy_turned_by_90_degrees_is_one():
    first = seen("a", roll=20.0, aside=40.0)
    for turns in (1, 2, 3):
        size_px = SIZE[::-1] if turns % 2 else SIZE
        center, turned_center = np.array(SIZE) / 2, np.array(size_px) / 2
        turn = np.linalg.matrix_power([[0, -1], [1, 0]], turns)
        matrix = np.eye(3)
        matrix[:2, :2], matrix[:2, 2] = turn, turned_center - turn @ center
        homography = matrix @ first.entry.geometry.homography_px_from_mm
        geometry = first.entry.geometry.changed(homography_px_from_mm=homography.tolist())
        copy = replace(first, entry=first.entry.changed(file="b", photo_px=size_px, geometry=geometry))
        assert reject_copies([first, copy], (0, 0), DESIGN_MM)[1].entry.code == "copy"


def test_rolled_paper_is_known_by_its_figures_and_equal_bytes_wherever_they_lie():
    rolled = [seen("a", flat=False), seen("b", azimuth=10.5, flat=False), seen("c", azimuth=20, flat=False)]
    assert [photo.counted for photo in reject_copies(rolled, (0, 0, 0), DESIGN_MM)] == [True, False, True]
    files = [seen("a", sha256="f" * 64), seen("b", azimuth=30, sha256="f" * 64), seen("c", azimuth=30, sha256="e" * 64)]
    kept = reject_copies(files, (0, 1, 1), DESIGN_MM)
    assert [photo.counted for photo in kept] == [True, False, True] and "a" in kept[1].entry.remark.advice
    nothing = MeasuredPhoto(PhotoEntry(file="d", status="rejected"), False)
    assert reject_copies([nothing, nothing], (0, 0), DESIGN_MM) == [nothing, nothing]


def test_no_two_of_many_drawn_views_are_taken_for_one():
    """Ten sessions of 40 in one light, from the default ranges."""
    rng, low, high = np.random.default_rng(0), (-60, 440, 2, -5), (60, 800, 27, 5)
    photos = [seen(str(i), *rng.uniform(low, high), aside=rng.uniform(-20, 20)) for i in range(400)]
    kept = reject_copies(photos, [i // 40 for i in range(400)], DESIGN_MM)
    assert all(photo.counted for photo in kept)


def test_copies_of_one_photograph_prove_nothing_and_are_named(tmp_path):
    photos = tmp_path / "photos"
    photos.mkdir()
    save(shot(), photos / "a.jpg")
    for i in range(5):
        shutil.copy(photos / "a.jpg", photos / f"b{i}.jpg")
    Image.open(photos / "a.jpg").save(photos / "c.jpg", quality=70)  # saved anew
    Image.open(photos / "a.jpg").resize((720, 540)).point(lambda code: 1.1 * code).save(photos / "i.jpg", quality=90)
    save(shot()[:, 100:700], photos / "d.jpg")  # a square: no other shape
    Image.fromarray(shot()[15:585, 40:760]).save(photos / "h.jpg", quality=70)
    save(shot(25, 500)[:, 200:], photos / "Screenshot_1.jpg")
    for name in ("e.mp4", "f.DNG", "a.mov"):  # the last is the first photograph's second of video
        (photos / name).write_bytes(b"x")
    save(shot(), photos / "x.jpg")
    (photos / "deep" / "deeper" / "deepest").mkdir(parents=True)
    shutil.copy(photos / "x.jpg", photos / "deep" / "deeper" / "deepest")
    (photos / "x.jpg").rename(photos / "deep" / "deeper" / "x.jpg")
    controls = tmp_path / "bare"
    controls.mkdir()
    for name in ("1.png", "2.png"):
        save(np.tile(np.linspace(0, 255, 100).astype(np.uint8)[:, None], (100, 1, 3)), controls / name)
    report = verified(photos, controls=controls)
    codes = {photo.file: photo.code for photo in report.photos}
    assert codes["a.jpg"] is None and {codes[f"b{i}.jpg"] for i in range(5)} == {codes["c.jpg"]} == {"copy"}
    assert codes["d.jpg"] == codes["h.jpg"] == codes["i.jpg"] == "copy"
    assert codes["Screenshot_1.jpg"] == "cropped"
    summary = report.summary
    assert (summary.photos, summary.judged, summary.verdict) == (11, 2, "cannot_tell")
    assert report.controls[0].n == 1
    lines = "\n".join(verdict_lines(report))
    for words in (
        "copy: 5 (b0.jpg, b1.jpg, b2.jpg and 2 more): its bytes are those of a.jpg",
        "copy: 4 (c.jpg, d.jpg, h.jpg and 1 more): it shows what a.jpg shows",
        "cropped: 1 (Screenshot_1.jpg): it is a crop or a screenshot",
        "take still photographs): e.mp4",
        "save them as JPEG): f.DNG",
        "one folder for each session): deep/deeper, deep/deeper/deepest",
        "bare/2.png has the bytes of bare/1.png",
    ):
        assert words in lines
    assert "a.mov" not in lines
    table = photos_csv(report.model_dump(mode="json")["photos"])
    assert table.count(",copy,") == 9 and '"its bytes are those of a.jpg' in table


@pytest.mark.parametrize(
    ("size", "tags", "name", "part"),
    [
        ((400, 300), {0xA002: 4000, 0xA003: 3000}, "a.jpg", False),  # all of it, made smaller
        ((300, 400), {0xA002: 4000, 0xA003: 3000}, "a.jpg", False),
        ((400, 297), {0xA002: 4000, 0xA003: 3000}, "a.jpg", False),  # within a percent, and a pixel
        ((400, 296), {0xA002: 4000, 0xA003: 3000}, "a.jpg", True),
        ((400, 300), {0x9286: b"ASCII\0\0\0Screenshot"}, "a.jpg", True),
        ((400, 300), {}, "Screen Shot 1.jpg", True),
        ((400, 300), {}, "a.jpg", False),
    ],
)
def test_a_crop_and_a_screenshot_are_known_by_exif_and_name(tmp_path, size, tags, name, part):
    exif = Image.Exif()
    for key, value in tags.items():
        exif.get_ifd(0x8769)[key] = value
    Image.new("RGB", size).save(tmp_path / name, exif=exif)
    assert read_photo(tmp_path / name).is_crop == part


def test_a_folder_of_raw_files_alone_is_refused_with_their_names(tmp_path):
    (tmp_path / "a.cr3").write_bytes(b"x")
    with pytest.raises(Refused, match=r"got none; raw files.*a\.cr3"):
        verified(tmp_path)
    assert list_skipped_files(tmp_path / "nowhere") == []


def test_archives_and_links_that_lead_nowhere_are_named(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"x")
    (tmp_path / "b.jpg").symlink_to(tmp_path / "gone.jpg")
    archives, links = list_skipped_files(tmp_path)
    assert archives.startswith("archives") and archives.endswith("a.zip")
    assert links == "links to files that are not there: b.jpg"


def test_codes_of_photographs_come_with_names_and_advice():
    photos = [{"file": f"{i}.jpg", "code": "blurred", "advice": "hold still"} for i in range(5)]
    photos += [{"file": "z.jpg", "code": "tilted", "advice": "turn"}, {"file": "y.jpg", "code": None, "advice": "-"}]
    expected = [("blurred", "hold still", 5, "0.jpg, 1.jpg, 2.jpg and 2 more"), ("tilted", "turn", 1, "z.jpg")]
    assert remarks(photos) == expected


def test_a_photograph_is_compared_with_those_like_it_however_many_there_are(monkeypatch):
    compared, find = [], grouping._is_repeated
    monkeypatch.setattr(grouping, "_is_repeated", lambda view, rows: compared.append(len(rows)) or find(view, rows))
    rng, low, high = np.random.default_rng(0), (-60, 440, 2, -5), (60, 800, 27, 5)
    drawn = [seen(str(i), *rng.uniform(low, high), aside=rng.uniform(-20, 20)) for i in range(80)]  # in one session
    assert all(photo.counted for photo in reject_copies(drawn, (0,) * 80, DESIGN_MM))
    assert len(compared) == 80 and sum(compared) < 80 * 79 / 2 / 10
