"""What of a texture may change: named faces' texels and no others, the look kept, and doubts said aloud."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial import Delaunay
from tolerances import CODE

from patchproof.base.color import linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.settings import PatchSettings
from patchproof.mesh.load_mesh import load_mesh
from patchproof.mesh.mesh import Material, MeshPart, mesh_from_parts
from patchproof.mesh.unwrap import coverage, texels_per_face
from patchproof.scene.texture_scene import texture_canvas

HERE = Path(".")
WHOLE = PatchSettings(kind="texture")
PAINT = np.random.default_rng(0).integers(0, 256, (16, 16, 3), dtype=np.uint8)
PAINTED = Material("paint", (1.0, 1.0, 1.0), PAINT)


def square(x: float, uv=((0, 1), (1, 1), (1, 0), (0, 0)), material=None, colors=None) -> MeshPart:
    """A 1×1 square at x, seen from +z, its texture upright."""
    corners = np.array([[x, 0, 0], [x + 1, 0, 0], [x + 1, 1, 0], [x, 1, 0]], float)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    material = material or PAINTED
    return MeshPart(corners, faces, material, None if uv is None else np.asarray(uv, float), None, colors)


def cell(column: int, row: int, cells: int = 4) -> np.ndarray:
    """UV corners of one cell of a texture cut into cells."""
    return (np.array([(0, 1), (1, 1), (1, 0), (0, 0)]) + np.array([column, row])) / cells


def masked(**keys) -> PatchSettings:
    return PatchSettings(kind="masked", **keys)


# ------------------------------------------------------------------------------------------------ texels


def twin(corners, size, grow):
    """Slow: clip each triangle to the square round a texel's center; covered where something is left."""
    width, height = size
    out = np.zeros((height, width), int)
    for triangle in corners:
        low, high = np.floor(triangle.min(0) - grow).astype(int), np.ceil(triangle.max(0) + grow).astype(int)
        for y in range(low[1] - 1, high[1] + 1):
            for x in range(low[0] - 1, high[0] + 1):
                polygon = list(triangle)
                for axis, center in ((0, x + 0.5), (1, y + 0.5)):
                    for sign in (1, -1):
                        polygon = clip(polygon, axis, sign, center * sign + grow)
                out[y % height, x % width] += len(polygon) > 0
    return out


def clip(polygon, axis, sign, bound):
    """The part of a polygon where sign * coordinate <= bound."""
    kept = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        inside = [sign * p[axis] <= bound for p in (a, b)]
        if inside[0] != inside[1]:
            kept.append(a + (b - a) * (bound - sign * a[axis]) / (sign * b[axis] - sign * a[axis]))
        if inside[1]:
            kept.append(b)
    return kept


@pytest.mark.parametrize("grow", [0.5, 1.0, 1.5])
def test_grown_coverage_is_that_of_clipped_polygons(grow):
    rng = np.random.default_rng(1)
    corners = rng.uniform(-6, 18, (40, 1, 2)) + rng.uniform(-4, 4, (40, 3, 2))
    corners[0, 1] = corners[0, 0]  # a line
    corners[1] = corners[1, 0]  # a point
    corners[2, :, 1] = 3.25  # flat
    assert np.array_equal(coverage(corners, (13, 9), grow), twin(corners, (13, 9), grow))


def test_faces_that_share_edges_cover_each_center_once():
    rng = np.random.default_rng(2)
    inner = np.concatenate([rng.uniform(0, 32, (200, 2)), rng.integers(0, 32, (100, 2)) + 0.5])  # many on centers
    points = np.concatenate([np.array([[0, 0], [32, 0], [0, 32], [32, 32.0]]), inner])
    corners = points[Delaunay(points).simplices]
    assert (coverage(corners, (32, 32)) == 1).all()
    assert (coverage(corners + np.array([1000, -7]), (32, 32)) == 1).all()  # wrapped round
    assert (coverage(corners * 3, (32, 32)) == 9).all()  # three turns each way
    mask = rng.random((32, 32)) < 0.4
    inside, centers = texels_per_face(corners, mask)
    assert centers.sum() == 32 * 32 and inside.sum() == mask.sum()
    assert np.array_equal(inside[::50], [(coverage(face[None], (32, 32)) * mask).sum() for face in corners[::50]])
    assert np.array_equal(texels_per_face(corners * 3, mask)[0].sum(), 9 * mask.sum())


# ------------------------------------------------------------------------------------------------ what may change


def test_a_whole_texture_may_change_where_faces_show_it():
    mesh = mesh_from_parts([square(0, cell(1, 1))], 100)
    canvas = texture_canvas(mesh, WHOLE, HERE)
    expected = np.zeros((16, 16), bool)
    expected[2:9, 2:9] = True  # texels 4 to 7, one more all round, and a second one where its center is just within
    assert np.array_equal(canvas.mask[0], expected)
    assert np.array_equal(canvas.start_srgb[0], PAINT) and canvas.names == ("paint",) and canvas.warnings == ()


def test_the_mask_holds_every_texel_that_a_look_up_in_a_named_face_reads(data, tmp_path):
    mesh = load_mesh(data / "meshes" / "spot.glb", 300)
    (tmp_path / "faces.txt").write_text("# an ear\n100-180\n 7\n\n3000 - 3010  # and more\n")
    canvas = texture_canvas(mesh, masked(faces="faces.txt"), tmp_path)
    named = np.r_[100:181, 7, 3000:3011]
    rng = np.random.default_rng(3)
    weights = rng.dirichlet([0.3] * 3, (len(named), 200))
    uv = np.einsum("fnk,fkc->fnc", weights, mesh.corner_uv[named].astype(float)).reshape(-1, 2)
    texel = np.floor(uv * 1024 - 0.5).astype(int)
    for step in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = ((texel + step) % 1024).T
        assert canvas.mask[0][y, x].all()
    away = coverage(np.delete(mesh.corner_uv, named, axis=0).astype(float) * 1024, (1024, 1024)) > 0
    own = coverage(mesh.corner_uv[named].astype(float) * 1024, (1024, 1024), 0.5) > 0
    assert (canvas.mask[0] & away & ~own).sum() < 0.5 * own.sum()  # a rim of one texel
    assert not canvas.warnings


def test_material_names_choose_faces():
    red, blue = Material("red", (1.0, 0, 0)), Material("blue", (0, 0, 1.0))
    mesh = mesh_from_parts([square(0, material=red), square(1, material=blue)], 100)
    canvas = texture_canvas(mesh, masked(materials=("blue",)), HERE, 8)
    assert [mask.sum() for mask in canvas.mask] == [0, 64] and canvas.start_srgb[0].shape == (1, 1, 3)
    with pytest.raises(Refused, match=r'name of a material, got "blu": did you mean "blue"'):
        texture_canvas(mesh, masked(materials=("blu",)), HERE)


def test_an_image_chooses_texels_at_any_size(tmp_path):
    half = np.zeros((5, 8), np.uint8)
    half[:, 4:] = 128
    Image.fromarray(half).save(tmp_path / "mask.png")
    deep = np.where(half, 40000, 600).astype(np.uint16)  # 600 of 65535 is black, 600 clipped at 255 would be white
    Image.fromarray(deep).save(tmp_path / "deep.png")
    mesh = mesh_from_parts([square(0)], 100)
    for name in ("mask.png", "deep.png"):
        canvas = texture_canvas(mesh, masked(mask=name, start="gray"), tmp_path)
        assert canvas.mask[0][:, 8:].all() and not canvas.mask[0][:, :8].any()
        assert (canvas.start_srgb[0][:, 8:] == 128).all() and np.array_equal(canvas.start_srgb[0][:, :8], PAINT[:, :8])
        assert np.array_equal(canvas.mesh.materials[0].texture_srgb, PAINT)  # the bare object stays as it is


@pytest.mark.parametrize(("size", "said"), [((128, 256), False), ((256, 512), True), ((127, 256), True)])
def test_a_mask_of_another_size_than_its_texture_is_said(tmp_path, size, said):
    Image.fromarray(np.full(size[::-1], 255, np.uint8)).save(tmp_path / "mask.png")
    gray = Material("gray", (1.0, 1.0, 1.0), np.full((256, 128, 3), 60, np.uint8))
    warnings = texture_canvas(
        mesh_from_parts([square(0, material=gray)], 100), masked(mask="mask.png"), tmp_path
    ).warnings
    assert len(warnings) == said
    if said:
        assert warnings[0].startswith(
            f"the mask of {size[0]} × {size[1]} pixels is laid over 128 × 256 texels: a texel"
        )


def test_a_mask_of_a_whole_multiple_of_the_texels_chooses_what_was_drawn(tmp_path):
    """Upright, as EXIF has it."""
    drawn, exif = np.zeros((960, 960), np.uint8), Image.Exif()
    drawn[320:640, :320], exif[0x0112] = 255, 3
    Image.fromarray(drawn[::-1, ::-1].copy()).save(tmp_path / "mask.png", exif=exif)
    material = Material("m", (1.0, 1.0, 1.0), np.full((96, 96, 3), 60, np.uint8))
    mesh = mesh_from_parts([square(0, material=material)], 100)
    (mask,) = texture_canvas(mesh, masked(mask="mask.png"), tmp_path).mask
    assert mask[32:64, :32].all() and mask.sum() == 32 * 32


def test_unusable_masks_are_refused(tmp_path):
    mesh = mesh_from_parts([square(0, cell(0, 0))], 100)

    def refuses(match, **keys):
        with pytest.raises(Refused, match=match):
            texture_canvas(mesh, masked(**keys), tmp_path)

    Image.fromarray(np.full((4, 4), 127, np.uint8)).save(tmp_path / "black.png")
    elsewhere = np.zeros((16, 16), np.uint8)
    elsewhere[8:12] = 255
    Image.fromarray(elsewhere).save(tmp_path / "elsewhere.png")
    (tmp_path / "text.png").write_text("no picture")
    refuses("white where the texture may change, got no lighter gray than 127 of 255 in black.png", mask="black.png")
    refuses("a mask that covers a face, got a mask that covers none of 2 faces", mask="elsewhere.png")
    refuses("text.png that cannot be read", mask="text.png")
    refuses("no file at", mask="none.png")
    refuses("no file at", faces="none.txt")
    for text in ("0\n2", "-1", "1-0", "a", "0-1-1", "1 0", "99999999999999999999"):
        (tmp_path / "faces.txt").write_text(text)
        refuses(r"a face number or a range a-b from 0 to 1, got .* of faces.txt", faces="faces.txt")
    (tmp_path / "faces.txt").write_text("# nothing\n")
    refuses("one per line, got no number in faces.txt", faces="faces.txt")
    bare = mesh_from_parts([square(0, None)], 100)
    Image.fromarray(elsewhere).save(tmp_path / "mask.png")
    with pytest.raises(Refused, match="coordinates for a mask, got 2 faces without any: name materials or faces"):
        texture_canvas(bare, masked(mask="mask.png"), tmp_path)


def test_base_colors_move_into_the_textures_and_the_look_stays():
    base = (0.3, 1.0, 0.7)
    mesh = mesh_from_parts(
        [square(0, material=Material("m", base, PAINT)), square(1, material=Material("n", base))], 100
    )
    canvas = texture_canvas(mesh, WHOLE, HERE, 32)
    assert [texture.shape for texture in canvas.start_srgb] == [(16, 16, 3), (32, 32, 3)]
    assert all(material.base_color_linear == (1, 1, 1) for material in canvas.mesh.materials)
    light = linear_from_srgb(PAINT / 255) * base
    got = canvas.start_srgb[0] / 255
    # half a code up or down encloses the exact color
    assert (linear_from_srgb(got - CODE / 2 - 1e-9) <= light).all() and (
        light <= linear_from_srgb(got + CODE / 2 + 1e-9)
    ).all()
    assert np.ptp(canvas.start_srgb[1], axis=(0, 1)).max() == 0


# ------------------------------------------------------------------------------------------------ doubts


def test_shared_texels_are_measured_and_said():
    apart = mesh_from_parts([square(i, cell(i, 0)) for i in range(4)], 100)
    assert texture_canvas(apart, WHOLE, HERE).warnings == ()
    mirrored = square(1, cell(0, 0)[[1, 0, 3, 2]])
    mesh = mesh_from_parts([square(0, cell(0, 0)), mirrored, square(2, cell(2, 0)), square(3, cell(3, 0))], 100)
    (warning,) = texture_canvas(mesh, WHOLE, HERE).warnings
    assert warning.startswith("50% of the surface") and "another place" in warning
    tiled = mesh_from_parts([square(0, cell(0, 0, 1) * 3)], 100)
    assert texture_canvas(tiled, WHOLE, HERE).warnings[0].startswith("100%")


def test_doubts_are_about_what_an_image_lets_change(tmp_path):
    uv = [cell(0, 0), cell(0, 0), cell(2, 0), cell(3, 0)]
    mesh = mesh_from_parts([square(i, corners) for i, corners in enumerate(uv)], 100)
    left = np.zeros((4, 4), np.uint8)
    for name, columns, warns in (("a.png", [0, 2], "67% of"), ("b.png", [2, 3], None)):
        picture = left.copy()
        picture[:, columns] = 255
        Image.fromarray(picture.repeat(4, 0).repeat(4, 1)).save(tmp_path / name)  # as large as the texture
        warnings = texture_canvas(mesh, masked(mask=name), tmp_path).warnings
        assert warnings[0].startswith(warns) if warns else warnings == ()


def test_a_front_and_a_back_are_one_place():
    front = square(0)
    mesh = mesh_from_parts([front, replace(front, faces=front.faces[:, ::-1])], 100)
    assert texture_canvas(mesh, WHOLE, HERE).warnings == ()


def test_faces_that_change_unnamed_are_said(tmp_path):
    mesh = mesh_from_parts(
        [square(0, cell(0, 0)), square(1, cell(0, 0)), square(2, cell(2, 0)), square(3, cell(3, 0))], 100
    )
    (tmp_path / "faces.txt").write_text("0-1")
    warnings = texture_canvas(mesh, masked(faces="faces.txt"), tmp_path).warnings
    assert any(warning.startswith("25% of the surface changes too") for warning in warnings)


def test_a_palette_is_told_from_a_fine_mesh():
    """A swatch per square is a palette; thousands of faces smaller than a texel that cover a texture are not."""
    swatches = [square(i, np.tile(cell(i % 4, i // 4).mean(0), (4, 1))) for i in range(8)]
    (warning,) = texture_canvas(mesh_from_parts(swatches, 100), WHOLE, HERE).warnings
    assert warning.startswith("100% of the surface") and "palette" in warning
    n = 40  # 3200 faces on 256 texels
    x, y = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
    points = np.stack([x, y, 0 * x], -1).reshape(-1, 3) / n
    corner = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    faces = (corner[:, :, None] + np.array([[0, 1, n + 2], [0, n + 2, n + 1]])).reshape(-1, 3)
    fine = MeshPart(points, faces, Material("m", (1, 1, 1), PAINT), points[:, :2] * [1, -1] + [0, 1])
    assert texture_canvas(mesh_from_parts([fine], 100), WHOLE, HERE).warnings == ()


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("kaykit_trafficlight_A", ["palette", "another place"]),
        ("gz_stop_light", ["another place"]),
        ("box_textured", ["another place"]),
        ("teapot", ["unwrapped (xatlas)"]),
        ("spot", []),
        ("mug_mujoco", []),
        ("banana_ycb", []),
        ("gz_stop_sign", []),
    ],
)
def test_doubts_about_real_meshes(data, name, says):
    warnings = texture_canvas(load_mesh(data / "meshes" / f"{name}.glb", 300), WHOLE, HERE, 256).warnings
    assert len(warnings) == len(says) and all(word in text for word, text in zip(says, warnings, strict=True))


def test_vertex_colors_over_a_texture_are_said():
    mesh = mesh_from_parts([square(0, colors=np.full((4, 3), 0.5))], 100)
    canvas = texture_canvas(mesh, WHOLE, HERE)
    assert "vertex colors still multiply" in canvas.warnings[0]
    assert (canvas.mesh.corner_color_linear == 0.5).all()
