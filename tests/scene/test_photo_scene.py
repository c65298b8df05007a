"""Scenes of photographs: synthetic photographs of a blank sheet whose geometry, light, blur and noise are known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
import pytest
from PIL import Image

from patchproof.base.color import LINEAR_FROM_CODE, srgb_from_linear
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import content_identity, files_sha256
from patchproof.base.geometry import apply_homography, intrinsics, look_at, plane_homography, rect_corners
from patchproof.base.packaged import packaged_path
from patchproof.base.settings import SceneSettings
from patchproof.photo.paper_light import paper_light, quadratic_terms
from patchproof.photo.rejection import PhotoRejected
from patchproof.scene import photo_scene
from patchproof.scene.conditions import with_values
from patchproof.scene.photo_scene import measure_photo, photos_in
from patchproof.scene.scene import build_scene
from patchproof.sheets.blank import blank_sheet
from patchproof.sheets.manifest import Manifest, dump_manifest
from patchproof.sheets.pdf_raster import rasterize_piece
from patchproof.sheets.piece import lay_out_piece, marker_rect, sheet_id

SIZE = (800, 600)
FINE = 3  # samples per pixel and axis
DPI = 254
# azimuth, elevation, distance, roll, blur, exposure
VIEWS = [
    (0, 0, 620, 0, 0.6, 0.75),
    (25, 10, 650, 5, 0.9, 0.5),
    (-30, 15, 700, -4, 1.1, 0.6),
    (40, 5, 680, 2, 0.7, 0.8),
    (-15, -10, 800, 10, 1.0, 0.35),
    (10, 30, 750, -8, 0.8, 0.65),
]
NOISE = 0.006


@dataclass(frozen=True)
class World:
    folder: object
    manifest: Manifest
    raster: np.ndarray  # linear light of the piece
    truth: dict  # by file name: (px_from_piece, light coefficients 3×6, blur)


def light_of(view: int, exposure: float) -> np.ndarray:
    """A gradient, a curvature and a color cast of a view, 3×6."""
    rng = np.random.default_rng(view)
    shape = np.array([1, 0, 0, 0, 0, 0]) + np.append(0, rng.uniform(-1, 1, 5) * [0.12, 0.12, 0.05, 0.05, 0.05])
    return exposure * np.array([1.0, 0.93, 0.82])[:, None] * shape


def homography(size_mm, azimuth, elevation, distance, roll) -> np.ndarray:
    """Pixels from piece millimeters of a camera that looks past the piece's middle."""
    az, el = np.radians([azimuth, elevation])
    eye = distance * np.array([np.cos(el) * np.sin(az), np.sin(el), np.cos(el) * np.cos(az)])
    world_from_piece = np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_piece[:2, 3] = [-size_mm[0] / 2, size_mm[1] / 2]
    return plane_homography(intrinsics(40, SIZE), look_at(eye, [20, -10, 0], roll), world_from_piece)


@cache
def _terms(rows: int, columns: int, *size_mm: float) -> np.ndarray:
    """Those of the light at each pixel of the piece's raster, which all photographs share."""
    mm = np.stack(np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows), -1) * size_mm
    return quadratic_terms(mm.reshape(-1, 2), np.array(size_mm)).astype(np.float32)


def save(pixels: np.ndarray, path) -> None:
    Image.fromarray(pixels).save(path, compress_level=1)


def photograph(raster, px_from_piece, size_mm, light, blur, seed) -> np.ndarray:
    """uint8 sRGB: the piece's reflectance in front of a striped wall, lit, blurred, noisy."""
    rows, columns = raster.shape[:2]
    lit = raster * (_terms(rows, columns, *size_mm) @ light.T.astype(np.float32)).reshape(rows, columns, 3)
    size = (SIZE[0] * FINE, SIZE[1] * FINE)
    raster_from_piece = np.diag([columns / size_mm[0], rows / size_mm[1], 1.0])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    to_px = np.array([[1 / FINE, 0, 0.5 / FINE], [0, 1 / FINE, 0.5 / FINE], [0, 0, 1.0]])
    matrix = half @ raster_from_piece @ np.linalg.inv(px_from_piece) @ to_px
    wall = 0.15 + 0.1 * (np.arange(SIZE[0]) // 40 % 2)
    wall = np.broadcast_to(wall[None, :, None], (SIZE[1], SIZE[0], 3)).astype(np.float32)
    fine = np.ascontiguousarray(wall.repeat(FINE, 0).repeat(FINE, 1))
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    cv2.warpPerspective(lit.astype(np.float32), matrix, size, fine, flags, cv2.BORDER_TRANSPARENT)
    linear = cv2.GaussianBlur(cv2.resize(fine, SIZE, interpolation=cv2.INTER_AREA), (0, 0), blur)
    grain = np.random.default_rng(seed).normal(0, NOISE, linear.shape) * np.sqrt(np.maximum(linear, 0))
    return np.round(srgb_from_linear(np.clip(linear + grain, 0, 1)) * 255).astype(np.uint8)


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> World:
    folder = tmp_path_factory.mktemp("photos")
    manifest = blank_sheet("blank_a4", folder / "BLANK.pdf")
    raster = LINEAR_FROM_CODE.astype(np.float32)[rasterize_piece(folder / "BLANK.pdf", manifest, DPI)]
    size_mm, truth = np.array(manifest.cut_mm[2:]), {}
    (folder / "photos").mkdir()
    for i, (*pose, blur, exposure) in enumerate(VIEWS):
        where, light = homography(size_mm, *pose), light_of(i, exposure)
        save(photograph(raster, where, size_mm, light, blur, i), folder / "photos" / f"{i}.png")
        truth[f"{i}.png"] = (where, light, blur)
    return World(folder, manifest, raster, truth)


def settings_of(world: World, **tables) -> SceneSettings:
    """Photographs at their own size, without the scene's own camera effects unless asked for."""
    tables = {"patch": {}, "camera": {"photo_px": SIZE}} | tables
    return SceneSettings.model_validate(
        {"object": {"photos": "photos", "sheet": "BLANK.json"}, "target": {"label": 1, "models": ["builtin"]}} | tables
    )


@pytest.fixture(scope="module")
def scene(world):
    return build_scene(settings_of(world), world.folder, 0)


def still(scene, n: int):
    """Conditions that show photograph 0, 1, ... as it is."""
    drawn = scene.draw("promise", n)
    background = drawn.pose.background.copy()
    background[:, 0] = (np.arange(n) + 0.5) / len(scene.photos)
    low, high = scene.settings.view.zoom
    background[:, 1] = np.log(1 / low) / np.log(high / low)  # zoom 1
    return with_values(drawn, background=background, roll_deg=np.zeros(n), look_at_offset=np.zeros((n, 3)))


def test_geometry_light_blur_and_noise_are_recovered(world, scene):
    """Corners of the piece within 0.1 px, light over it within 2 %, blur within 0.3 px, noise within 15 %."""
    conditions = still(scene, len(VIEWS))
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 9)), -1).reshape(-1, 2)
    terms = quadratic_terms(grid * scene.piece.size_mm, scene.piece.size_mm)
    found = zip(
        scene.piece_homographies(conditions, SIZE),
        scene.piece_light(conditions),
        *scene.picture_blur_and_noise(conditions),
        world.truth.values(),
        strict=True,
    )
    corners = rect_corners((0, 0, *scene.piece.size_mm))
    for where, light, blur, noise, (true_where, true_light, true_blur) in found:
        miss = np.linalg.norm(apply_homography(where, corners) - apply_homography(true_where, corners), axis=1)
        assert miss.max() < 0.1
        assert np.abs((terms @ light.T) / (terms @ true_light.T) - 1).max() < 0.02
        assert blur == pytest.approx(true_blur, abs=0.3)
        assert noise == pytest.approx(NOISE, rel=0.15)


def test_the_piece_is_the_blank_s_with_ids_of_its_own(world, scene):
    blank = lay_out_piece((162.0, 162.0), 19.0, world.manifest.sheet_id, "blank")
    assert scene.piece.size_mm == blank.size_mm and len(scene.piece.markers) == 4
    for mine, printed in zip(scene.piece.markers, blank.markers, strict=True):
        assert np.array(mine.corners_mm) == pytest.approx(np.array(printed.corners_mm), abs=2e-6)
    assert {m.id for m in scene.piece.markers} != {m.id for m in blank.markers}
    assert (scene.settings.patch.width_mm, scene.settings.patch.height_mm) == (162.0, 162.0)
    assert all("can be measured" in warning for warning in scene.warnings)
    # the id follows from the settings with the blank's size filled in, as a run keeps them, and from the photographs
    digest = files_sha256(photos_in(scene.base / scene.settings.object.photos))
    known = content_identity(scene.settings, scene.base) | {"blank": world.manifest.sheet_id, "photos": digest}
    assert sheet_id(known, 0) == scene.sheet_id != sheet_id(known, 1)


def test_hidden_files_and_folders_hold_no_photographs(tmp_path):
    for name in ("b.jpg", "._b.jpg", ".thumbnails/b.jpg", "session_01/a.jpg", "session_01/._a.jpg", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert photos_in(tmp_path) == [tmp_path / "b.jpg", tmp_path / "session_01" / "a.jpg"]


def test_another_template_is_the_scene_made_for_it(world, scene):
    made = build_scene(settings_of(world, sheet={"template": "letter"}), world.folder, 0)
    changed = scene.with_template("letter")
    assert scene.with_template("a4") is scene and changed.photos is scene.photos
    assert (changed.settings, changed.sheet_id, changed.piece) == (made.settings, made.sheet_id, made.piece)
    assert changed.warnings == made.warnings and np.array_equal(
        changed.piece_light(still(scene, 3)), made.piece_light(still(scene, 3))
    )


def test_markers_that_a_smaller_photograph_cannot_show_are_counted(scene):
    """Modules of 19 / 7 mm at about 1.1 px per mm: near 2.5 px at 800 × 600, far below it at half the size."""
    assert scene.unreadable_share < 0.5
    far = tuple(replace(p, photo_from_piece=np.diag([0.5, 0.5, 1]) @ p.photo_from_piece) for p in scene.photos)
    assert replace(scene, photos=far).unreadable_share == 1


def test_a_square_is_the_middle_of_the_photograph(scene):
    conditions = scene.draw("promise", 4)
    whole, square = scene.pictures(conditions, SIZE), scene.pictures(conditions, (600, 600))
    apart = np.abs(whole[:, :, 100:700].astype(int) - square)
    assert apart.max() <= 4 and apart.mean() < 0.05  # OpenCV before 5 places samples in 32nds of a pixel
    point = np.array([[30.0, 70.0]])
    for a, b in zip(
        scene.piece_homographies(conditions, SIZE), scene.piece_homographies(conditions, (224, 224)), strict=True
    ):
        there, here = apply_homography(a, point), apply_homography(b, point)
        assert (there - [100, 0]) * 224 / 600 == pytest.approx(here, abs=1e-9)


def test_a_photograph_as_it_was_comes_back(world, scene):
    for picture, name in zip(scene.pictures(still(scene, 6), SIZE), world.truth, strict=True):
        assert np.array_equal(picture, np.asarray(Image.open(world.folder / "photos" / name)))


@pytest.mark.parametrize("size_px", [SIZE, (600, 600), (224, 224)])
def test_picture_and_homography_move_alike(scene, size_px):
    """A dot painted on the piece's middle is seen where the homography says, zoomed, rolled and shifted."""
    middle = np.array(scene.piece.size_mm) / 2
    dotted = []
    for photo in scene.photos:
        picture = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
        x, y = apply_homography(photo.photo_from_piece, middle[None])[0]
        rows, columns = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
        picture[:] = 255 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 2 / 5**2)[..., None]
        dotted.append(replace(photo, picture=[np.round(picture).astype(np.uint8)]))
    scene = replace(scene, photos=tuple(dotted))
    conditions = scene.draw("evaluate", 12)
    assert np.ptp(scene.picture_blur_and_noise(conditions)[0]) > 0.1 and np.ptp(conditions.pose.roll_deg) > 4
    pictures = scene.pictures(conditions, size_px)
    for picture, where in zip(pictures, scene.piece_homographies(conditions, size_px), strict=True):
        weight = picture[..., 0].astype(float)
        rows, columns = np.mgrid[: size_px[1], : size_px[0]] + 0.5
        seen = [(weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()]
        assert seen == pytest.approx(apply_homography(where, middle[None])[0], abs=0.1)


def test_zoom_takes_the_blur_along(scene):
    conditions = still(scene, 2)
    low = scene.settings.view.zoom[0]
    background = conditions.pose.background.copy()
    background[:, 1] = 0
    small = with_values(conditions, background=background)
    assert scene.picture_blur_and_noise(small)[0] == pytest.approx(scene.picture_blur_and_noise(conditions)[0] * low)


def test_photographs_of_another_size_and_shape_agree_in_their_square(world, tmp_path):
    """A portrait crop of a photograph, twice the size: its centered square is the scene's, blur and places follow."""
    name, (where, _, blur) = next(iter(world.truth.items()))
    pixels = np.asarray(Image.open(world.folder / "photos" / name))[:, 160:640]  # 480 × 600
    Image.fromarray(pixels).resize((960, 1200), Image.Resampling.BICUBIC).save(tmp_path / "tall.png", compress_level=1)
    piece = lay_out_piece((162.0, 162.0), 19.0, "A1B2C3D4E5", "design")
    seen = measure_photo(tmp_path / "tall.png", world.manifest, piece, (640, 480))
    # (x - 160, y) in 480 × 600 has its square from y = 60 on; 480 px of it become 480
    expected = np.array([[1, 0, -160 + 80], [0, 1, -60], [0, 0, 1.0]]) @ where
    corners = rect_corners((0, 0, *piece.size_mm))
    found = apply_homography(seen.photo_from_piece, corners)
    assert np.abs(found - apply_homography(expected, corners)).max() < 0.1
    assert seen.blur_px == pytest.approx(blur, abs=0.3)
    assert min(seen.picture[0].shape[:2]) == 480


def test_glare_and_shadow_do_not_move_the_light():
    """A highlight on a tenth and a shadow's edge on a tenth of the paper: within 2 % of the light elsewhere."""
    piece = lay_out_piece((162.0, 162.0), 19.0, "A1B2C3D4E5", "blank")
    width, height = (round(4 * side) for side in piece.size_mm)
    px_from_piece = np.diag([width / piece.size_mm[0], height / piece.size_mm[1], 1.0])
    rows, columns = np.mgrid[:height, :width] + 0.5
    terms = quadratic_terms(np.stack([columns.ravel() / 4, rows.ravel() / 4], 1), piece.size_mm)
    light = light_of(3, 0.6)
    picture = (terms @ light.T).reshape(height, width, 3)
    glare = (columns - 0.6 * width) ** 2 + (rows - 0.4 * height) ** 2 < 0.032 * width * height
    picture[glare] = np.minimum(picture[glare] * 1.3, 0.95)
    picture[(columns < 0.3 * width) & (rows > 0.6 * height)] *= 0.6
    codes = np.round(srgb_from_linear(picture) * 255).astype(np.uint8)
    area, printed = (0.0, 0.0, *piece.size_mm), map(marker_rect, piece.markers)
    found = paper_light(codes, px_from_piece, area, printed, 0.5)
    assert np.abs((terms @ found.coefficients.T) / (terms @ light.T) - 1).max() < 0.02
    assert found.unevenness > 0.05  # and it shows


def test_overexposed_paper_is_clipped():
    with pytest.raises(PhotoRejected, match="clipped: the paper is overexposed"):
        paper_light(np.full((400, 400, 3), 255, np.uint8), np.diag([2.0, 2.0, 1.0]), (0, 0, 162, 162), [], 0.5)


def test_photographs_that_cannot_be_used_are_named(world, scene, tmp_path, monkeypatch):
    known = dict(zip(world.truth, scene.photos, strict=True))  # as they were measured for that scene
    monkeypatch.setattr(
        photo_scene, "measure_photo", lambda path, *more: known.get(path.name) or measure_photo(path, *more)
    )
    for name in ("photos", "BLANK.json"):
        (tmp_path / name).symlink_to(world.folder / name)
    (tmp_path / "mixed").mkdir()
    for path in (world.folder / "photos").iterdir():
        (tmp_path / "mixed" / path.name).symlink_to(path)
    (tmp_path / "mixed" / "broken.jpg").write_bytes(b"no picture")
    Image.new("RGB", SIZE, "gray").save(tmp_path / "mixed" / "empty.png")
    object_ = {"photos": "mixed", "sheet": "BLANK.json"}
    scene = build_scene(settings_of(world, object=object_), tmp_path, 0)
    assert scene.warnings[:2] == (
        "broken.jpg is left out: unreadable",
        "empty.png is left out: too_few_markers",
    )
    (tmp_path / "mixed" / "3.png").unlink()
    (tmp_path / "sessions").mkdir()
    (tmp_path / "mixed").rename(tmp_path / "sessions" / "first")  # a folder a place, as `verify` has
    told = (
        r"at least 6 photographs.*got 5 usable of 7 in .*"
        r"\(first/broken.jpg: unreadable; first/empty.png: too_few_markers\): take"
    )
    with pytest.raises(Refused, match=told):
        build_scene(settings_of(world, object={"photos": "sessions", "sheet": "BLANK.json"}), tmp_path, 0)


@pytest.mark.parametrize(
    ("tables", "sentence"),
    [
        (
            {"patch": {"width_mm": 90, "height_mm": 110}},
            r"as large as the blank sheet's \(162 × 162 mm\), got 90 × 110",
        ),
        ({"patch": {"bend": True}}, r"got bend = true: give a mesh"),
        ({"object": {"photos": "nowhere", "sheet": "BLANK.json"}}, r"got 0 usable of 0"),
        ({"object": {"photos": "photos", "sheet": "none.json"}}, r"no file at"),
    ],
)
def test_what_does_not_fit_is_refused(world, tables, sentence):
    with pytest.raises(Refused, match=sentence):
        build_scene(settings_of(world, **tables), world.folder, 0)


def test_a_page_too_small_for_the_blank_s_piece_is_refused(world, tmp_path):
    text = packaged_path("print_templates", "a4.toml").read_text(encoding="utf-8")
    assert "167.0, 180.0]" in text
    (tmp_path / "small.toml").write_text(text.replace("167.0, 180.0]", "120.0, 120.0]"), encoding="utf-8")
    with pytest.raises(Refused, match=r"at most 119\.6 × 119\.6 mm on this page, got 162 × 162 mm"):
        build_scene(settings_of(world, sheet={"template": str(tmp_path / "small.toml")}), world.folder, 0)


def test_a_sheet_with_a_design_is_refused(world, tmp_path):
    design = world.manifest.model_copy(update={"kind": "design"})
    (tmp_path / "SHEET.json").write_text(dump_manifest(design), encoding="utf-8")
    tables = {"object": {"photos": str(world.folder / "photos"), "sheet": "SHEET.json"}}
    with pytest.raises(Refused, match="manifest of a blank sheet"):
        build_scene(settings_of(world, **tables), tmp_path, 0)


def test_each_unusable_photograph_has_its_code(world, tmp_path):
    piece = lay_out_piece((162.0, 162.0), 19.0, "A1B2C3D4E5", "design")
    sharp = np.asarray(Image.open(world.folder / "photos" / "0.png"))
    markers = world.manifest.markers
    free = sorted(set(range(1000)) - {m.id for m in markers})
    others = tuple(m.model_copy(update={"id": i}) for m, i in zip(markers, free, strict=False))
    foreign = world.manifest.model_copy(update={"markers": others})
    black = (slice(None), slice(0, 370)), (slice(0, 350), slice(None))  # all but the lower right corner's markers
    hidden = sharp.copy()
    for part in black:
        hidden[part] = 0
    raster, size_mm = world.raster, np.array(world.manifest.cut_mm[2:])
    near = homography(size_mm, 10, 5, 350, 0)  # 6.4 px a module, of which 3.2 px of blur are half
    cases = {
        "blurred": (photograph(raster, near, size_mm, light_of(0, 0.6), 3.2, 0), world.manifest),
        "wrong_sheet": (sharp, foreign),
        "too_few_markers": (hidden, world.manifest),
        "clipped": (np.minimum(sharp.astype(int) * 2, 255).astype(np.uint8), world.manifest),
    }
    for code, (pixels, manifest) in cases.items():
        save(pixels, tmp_path / "photo.png")
        with pytest.raises(PhotoRejected) as caught:
            measure_photo(tmp_path / "photo.png", manifest, piece, SIZE)
        assert caught.value.code == code, caught.value
