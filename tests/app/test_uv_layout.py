"""Pictures to draw masks on: numbers at the middles of faces' texture coordinates, and what may change by its area."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import label

from patchproof.app.begin.preview import PAGE, preview_scene
from patchproof.app.begin.uv_layout import FONT_PX, LARGEST_PX, uv_layouts
from patchproof.mesh.mesh import Material, from_parts
from patchproof.scene.texture import texture_canvas
from test_scene_texture import HERE, WHOLE, cell, masked, square

GRAY = Material("gray", (1.0, 1.0, 1.0), np.full((256, 128, 3), 60, np.uint8))  # 128 texels wide, 256 high


def inked(picture):
    """Where numbers are: red on gray."""
    return picture[..., 0].astype(int) - picture[..., 1] > 60


def test_each_face_s_number_lies_at_the_middle_of_its_texture_coordinates():
    shift = np.array([2, -3])  # whole textures away, which changes nothing
    mesh = from_parts([square(i, cell(i, i) + shift * (i == 2), GRAY) for i in range(3)], 100)
    (layout,) = uv_layouts(texture_canvas(mesh, WHOLE, HERE))
    assert layout.picture.shape == (2048, 1024, 3) and layout.texels == (128, 256)
    assert (layout.faces, layout.numbered) == (6, (0, 1, 2, 3, 4, 5)) and layout.material == "gray"
    parts, count = label(inked(layout.picture), np.ones((3, 3)))
    assert count == 6  # one digit each
    middles = np.array([np.argwhere(parts == i + 1).mean(0)[::-1] for i in range(count)])
    for face in range(6):
        # corners (0, 1), (1, 1), (1, 0) or (0, 1), (1, 0), (0, 0) of a cell of 256 × 512 pixels: at two thirds or one
        expected = (face // 2 + (2 - face % 2) / 3) * np.array([256, 512])
        assert np.abs(middles - expected).max(1).min() < 4, face


def test_numbers_stay_within_their_faces_and_go_where_they_do_not():
    """Right triangles with legs of s pixels have room s / (3 √2); one digit of 9 pixels asks for 4.2: s of 17.8."""
    for pixels, numbered in ((17.0, False), (19.0, True)):
        corners = np.array([(0, 1), (1, 1), (1, 0), (0, 0)]) * pixels / LARGEST_PX + 0.25
        material = Material("m", (1.0, 1.0, 1.0), np.full((64, 64, 3), 60, np.uint8))
        (layout,) = uv_layouts(texture_canvas(from_parts([square(0, corners, material)], 100), WHOLE, HERE))
        assert (layout.numbered == (0, 1)) == numbered and inked(layout.picture).any() == numbered
        rows, columns = np.nonzero(inked(layout.picture))
        if numbered:
            assert min(rows.min(), columns.min()) >= 512 and max(rows.max(), columns.max()) < 512 + pixels
    assert FONT_PX[1] == 9


def test_what_may_not_change_is_paler_by_area(tmp_path):
    left = np.zeros((256, 128), np.uint8)
    left[:, :32] = 255
    Image.fromarray(left).save(tmp_path / "mask.png")
    mesh = from_parts([square(0, material=GRAY)], 100)
    (layout,) = uv_layouts(texture_canvas(mesh, masked(mask="mask.png"), tmp_path))
    levels, counts = np.unique(layout.picture[~inked(layout.picture)][:, 0], return_counts=True)
    share = dict(zip(levels.tolist(), (counts / counts.sum()).tolist(), strict=True))
    assert share[158] == pytest.approx(0.25, abs=0.01) and share[226] == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize(("size", "said"), [((128, 256), False), ((256, 512), True), ((127, 256), True)])
def test_a_mask_of_another_size_than_its_texture_is_said(tmp_path, size, said):
    Image.fromarray(np.full(size[::-1], 255, np.uint8)).save(tmp_path / "mask.png")
    mesh = from_parts([square(0, material=GRAY)], 100)
    warnings = texture_canvas(mesh, masked(mask="mask.png"), tmp_path).warnings
    assert len(warnings) == said
    if said:
        assert warnings[0].startswith(
            f"the mask of {size[0]} × {size[1]} pixels is laid over 128 × 256 texels: a texel"
        )


def test_a_mask_drawn_on_the_layout_chooses_what_was_drawn(tmp_path):
    """White over the middle cell of nine, at the layout's own size."""
    material = Material("m", (1.0, 1.0, 1.0), np.full((96, 96, 3), 60, np.uint8))
    mesh = from_parts([square(0, material=material)], 100)
    (layout,) = uv_layouts(texture_canvas(mesh, WHOLE, HERE))
    height, width = layout.picture.shape[:2]
    drawn = np.zeros((height, width), np.uint8)
    drawn[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 255
    Image.fromarray(drawn).save(tmp_path / "mask.png")
    (mask,) = texture_canvas(mesh, masked(mask="mask.png"), tmp_path).mask
    expected = np.zeros((96, 96), bool)
    expected[32:64, 32:64] = True
    assert np.array_equal(mask, expected)


def test_preview_writes_the_layout_beside_its_page(tmp_path):
    (tmp_path / "scene.toml").write_text(
        '[object]\nmesh = "primitive:mailbox"\nlength_mm = 300\n[patch]\nkind = "masked"\n'
        'materials = ["body"]\n'
        '[target]\nlabel = "mailbox"\nmodels = ["builtin"]\n[camera]\nphoto_px = [96, 96]\n'
        "[background]\ncolor = [0.5, 0.5, 0.5]\n"
    )
    found = preview_scene(tmp_path / "scene.toml", tmp_path / "out")
    assert [path.name for path in (tmp_path / "out").glob("uv*.png")] == ["uv.png"]
    (line,) = (line.removeprefix("texture: ") for line in found.lines if line.startswith("texture: "))
    assert line.startswith('uv.png is the layout of "body", 1024 × 1024 texels; ') and "of its 60 faces" in line
    text = (tmp_path / "out" / PAGE).read_text(encoding="utf-8")
    assert "<h2>Its texture</h2>" in text and line.split("; ")[1] in text
