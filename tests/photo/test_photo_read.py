"""Any photograph comes out upright, 8-bit and whole, or is refused with a sentence."""

from __future__ import annotations

import errno
import math
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image, ImageCms

from patchproof.photo import read
from patchproof.photo.read import read_photo
from patchproof.photo.rejection import PhotoRejected

UPRIGHT = np.zeros((40, 60, 3), np.uint8)
UPRIGHT[:20, :30], UPRIGHT[:20, 30:], UPRIGHT[20:, :30] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
# how a camera stores the upright picture so that the tag's turn brings it back (EXIF 2.32, tag 0x0112)
STORED = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.transpose(1, 0, 2),
    6: lambda a: np.rot90(a, 1),
    7: lambda a: a[::-1, ::-1].transpose(1, 0, 2),
    8: lambda a: np.rot90(a, -1),
}


@pytest.mark.parametrize("orientation", range(1, 9))
def test_every_orientation_comes_out_upright(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / "photo.png"
    Image.fromarray(np.ascontiguousarray(STORED[orientation](UPRIGHT))).save(path, exif=exif)
    assert (read_photo(path).srgb == UPRIGHT).all()


def test_real_photographs_under_every_orientation_come_out_alike(data):
    for shape in ("Landscape", "Portrait"):
        files = sorted((data / "photos" / "exif_orientation").glob(f"{shape}_*.jpg"))
        small = [np.asarray(Image.fromarray(read_photo(f).srgb).resize((30, 30))).astype(float) for f in files]
        assert len(files) >= 3 and all(np.abs(one - small[0]).mean() < 6 for one in small)


def test_the_focal_length_is_scaled_to_the_photos_own_diagonal(tmp_path):
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.fromarray(UPRIGHT).save(tmp_path / "a.jpg", exif=exif)
    Image.fromarray(UPRIGHT).save(tmp_path / "b.jpg")
    # 26 / 43.2666 of the diagonal √(60² + 40²)
    assert read_photo(tmp_path / "a.jpg").focal_px == pytest.approx(26 / 43.2666 * math.hypot(60, 40))
    assert read_photo(tmp_path / "b.jpg").focal_px is None


@pytest.mark.parametrize(
    ("size", "tags", "spread", "cropped"),
    [
        ((400, 300), {0xA002: 400, 0xA003: 300}, 0.03, False),
        ((300, 400), {0xA002: 400, 0xA003: 300}, 0.03, False),  # turned without a word
        ((400, 300), {0xA002: 4000, 0xA003: 3000}, None, True),  # a part, or all of it made smaller: nobody knows
        ((400, 300), {0xA404: 2.0}, None, True),
        ((400, 300), {0xA404: 1.0}, 0.03, False),
        ((400, 297), {}, 0.03, False),
        ((400, 296), {}, None, True),
        ((300, 300), {}, None, True),
        ((480, 270), {}, 0.1, False),
        ((400, 300), {0x0131: "Adobe Photoshop 25.1"}, 0.1, False),
        ((400, 300), {0x0131: "HDR+ 1.0"}, 0.03, False),
    ],
)
def test_a_focal_length_of_another_picture_is_not_used(tmp_path, size, tags, spread, cropped):
    exif = Image.Exif()
    details = exif.get_ifd(0x8769)
    for key, value in ({0xA405: 26} | tags).items():
        (exif if key == 0x0131 else details)[key] = value
    Image.new("RGB", size).save(tmp_path / "a.jpg", exif=exif)
    photo = read_photo(tmp_path / "a.jpg")
    assert photo.focal_rejected == cropped and (photo.focal_px is None) == cropped
    if spread is not None:
        assert photo.focal_spread == spread and photo.focal_px == pytest.approx(26 / 43.2666 * math.hypot(*size))


@pytest.mark.parametrize("mode", ["CMYK", "L", "P", "RGBA", "LA", "1", "I;16"])
def test_every_mode_becomes_rgb(tmp_path, mode):
    gray = np.full((30, 40), 128, np.uint8)
    if mode == "I;16":
        image = Image.fromarray(np.full((30, 40), 128 * 257, np.uint16))
    elif mode == "1":
        image = Image.fromarray(gray > 0)
    else:
        image = Image.fromarray(gray).convert("RGB").convert("L" if mode == "LA" else mode)
        image = image.convert("LA") if mode == "LA" else image
        image = Image.fromarray(gray).convert("RGB").quantize(4) if mode == "P" else image
    path = tmp_path / ("photo.tif" if mode == "CMYK" else "photo.png")
    image.save(path)
    srgb = read_photo(path).srgb
    assert srgb.shape == (30, 40, 3) and srgb.dtype == np.uint8
    assert srgb.astype(float) == pytest.approx(255 if mode == "1" else 128, abs=2)


@pytest.mark.parametrize("mode", ["RGB", "RGBA"])
def test_an_embedded_profile_is_converted_and_alpha_kept(tmp_path, mode):
    """sRGB's own profile with red and green exchanged, under another name."""
    profile = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    profile = profile.replace("sRGB".encode("utf-16-be"), "gRBG".encode("utf-16-be"))
    for old, new in ((b"rXYZ", b"????"), (b"gXYZ", b"rXYZ"), (b"????", b"gXYZ")):
        profile = profile.replace(old, new)
    red = np.tile(np.array([255, 0, 0, 255], np.uint8), (8, 8, 1))
    red[:4, :, 3] = 0 if mode == "RGBA" else 255
    Image.fromarray(red).convert(mode).save(tmp_path / "a.png", icc_profile=profile)
    srgb = read_photo(tmp_path / "a.png").srgb.astype(int)
    assert np.abs(srgb[4:] - (0, 255, 0)).max() <= 2
    assert np.abs(srgb[:4] - ((255, 255, 255) if mode == "RGBA" else (0, 255, 0))).max() <= 2


def test_see_through_pixels_lie_on_white(tmp_path):
    Image.fromarray(np.zeros((8, 8, 4), np.uint8)).save(tmp_path / "clear.png")
    assert (read_photo(tmp_path / "clear.png").srgb == 255).all()


def test_a_text_file_a_cut_file_and_a_missing_one_are_unreadable(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (200, 200, 3), np.uint8)
    Image.fromarray(noise).save(tmp_path / "whole.jpg")
    (tmp_path / "cut.jpg").write_bytes((tmp_path / "whole.jpg").read_bytes()[:4000])
    (tmp_path / "text.jpg").write_text("not a picture")
    (tmp_path / "empty.jpg").write_bytes(b"")
    for name in ("cut.jpg", "text.jpg", "empty.jpg", "gone.jpg"):
        with pytest.raises(PhotoRejected) as caught:
            read_photo(tmp_path / name)
        assert caught.value.code == "unreadable" and caught.value.advice


def test_a_photograph_that_may_not_be_read_says_so(tmp_path, monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    (tmp_path / "a.jpg").touch()
    monkeypatch.setattr(read, "open_lazily", refuse)
    with pytest.raises(PhotoRejected) as caught:
        read_photo(tmp_path / "a.jpg")
    said = "a.jpg cannot be read (Permission denied): allow that, or copy it again"
    assert (caught.value.code, caught.value.advice) == ("unreadable", said)


@pytest.mark.parametrize("subsampling", ["4:4:4", "4:2:2", "4:2:0"])
@pytest.mark.parametrize("how", [{}, {"progressive": True}, {"quality": 30, "restart_marker_rows": 1}])
def test_opencv_reads_a_jpeg_as_pillow_does(tmp_path, monkeypatch, subsampling, how):
    """To the bit, at sizes that no block divides, also where a file goes on after its end; else Pillow does."""
    rng = np.random.default_rng(0)
    picture = np.clip(rng.normal(0, 20, (201, 303, 3)) + np.linspace(0, 255, 303)[:, None], 0, 255).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "a.jpg", subsampling=subsampling, **how)
    (tmp_path / "more.jpg").write_bytes((tmp_path / "a.jpg").read_bytes() + b"a film of a second")
    with Image.open(tmp_path / "a.jpg") as image:
        expected = np.asarray(image)
    for name in ("a", "more"):
        with Image.open(tmp_path / f"{name}.jpg") as image:
            assert np.array_equal(read._jpeg_codes(image, tmp_path / f"{name}.jpg"), expected)
        assert np.array_equal(read_photo(tmp_path / f"{name}.jpg").srgb, expected)
    monkeypatch.setattr("patchproof.photo.read.cv2.imdecode", lambda *_: None)
    assert np.array_equal(read_photo(tmp_path / "a.jpg").srgb, expected)


def test_a_jpeg_is_read_without_stderr(tmp_path):
    Image.fromarray(UPRIGHT).save(tmp_path / "a.jpg")
    code = "import os, sys; from patchproof.photo.read import read_photo; os.close(2); read_photo(sys.argv[1])"
    subprocess.run([sys.executable, "-c", code, tmp_path / "a.jpg"], check=True)


def test_too_many_pixels_are_refused_before_they_are_decoded(tmp_path, monkeypatch):
    Image.fromarray(UPRIGHT).save(tmp_path / "a.png")
    monkeypatch.setattr(read, "MAX_IMAGE_PX", 1000)
    with pytest.raises(PhotoRejected) as caught:
        read_photo(tmp_path / "a.png")
    assert (caught.value.figure, caught.value.threshold) == (2400, 1000)


@pytest.mark.parametrize(("mode", "suffix"), [("RGB", "jpg"), ("I;16", "png")])
def test_of_too_many_pixels_to_measure_four_become_one(mode, suffix, tmp_path, monkeypatch):
    """The mean of each four, turned upright, with the focal length in the pixels that there are."""
    codes = np.kron(np.arange(12, dtype=np.uint8).reshape(3, 4) * 20, np.ones((20, 20), np.uint8))
    image = Image.fromarray(codes.astype(np.uint16) * 257) if mode == "I;16" else Image.fromarray(codes).convert(mode)
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 36
    image.save(tmp_path / f"a.{suffix}", exif=exif, quality=100)
    monkeypatch.setattr(read, "WHOLE_PX", codes.size)
    whole = read_photo(tmp_path / f"a.{suffix}")
    monkeypatch.setattr(read, "WHOLE_PX", codes.size - 1)
    fewer = read_photo(tmp_path / f"a.{suffix}")
    assert whole.srgb.shape == (80, 60, 3) and fewer.srgb.shape == (40, 30, 3)
    expected = np.rot90(codes[::2, ::2], -1)[..., None]
    assert np.abs(fewer.srgb.astype(int) - expected).max() <= (0 if suffix == "png" else 3)
    assert fewer.focal_px == pytest.approx(whole.focal_px / 2) and whole.focal_px is not None


def test_heic_without_its_extra_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    (tmp_path / "a.heic").write_bytes(b"x")
    with pytest.raises(PhotoRejected, match=r"pip install 'patchproof\[heic\]'"):
        read_photo(tmp_path / "a.heic")


def test_codes_are_those_of_the_report():
    with pytest.raises(ValueError, match="expected one of unreadable"):
        PhotoRejected("odd", None, None, "nothing")
