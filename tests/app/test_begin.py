"""A scene file to begin with and a look at it: what was guessed, what is drawn, and what is refused."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh
from browser import Browser
from console import command

from patchproof.app.begin.guess import footing, guess_label, guess_length_mm, guess_up
from patchproof.app.begin.new import new_scene
from patchproof.app.begin.preview import (
    NO_SURFACE_RGB,
    PAGE,
    PICTURE_PX,
    RAMP_RGB,
    _unprintable,
    _up_warning,
    gap_colors,
    round_length,
    sample_views,
    side_of,
    side_views,
)
from patchproof.app.begin.preview import preview as preview_scene
from patchproof.base.errors import Refused
from patchproof.base.settings import load_scene_settings
from patchproof.classifier import load_classifier
from patchproof.optimizer.problem import set_problem
from patchproof.render.stage import set_stage
from patchproof.scene.placement import gap_limit_mm, largest_fitting_size
from patchproof.scene.scene import load_scene, make_scene
from patchproof.sheets.blank import blank_page

LABELS = ["coffee mug", "cup", "garbage truck, dustcart", "tow truck, tow car, wrecker", "mailbox, letter box"]
QUICK = {"camera": {"photo_px": [400, 300]}, "background": {"color": [0.5, 0.5, 0.5]}}


def box(width=300, photo_px=(400, 300), **patch):
    """A box 300 mm wide, 200 high and 100 deep, made in Python, with a piece on its front."""
    return make_scene(
        {
            "object": {"mesh": "python:box", "length_mm": 300, "up": "y"},
            "patch": {"width_mm": 90, "height_mm": 90, "side": "+z", **patch},
            "target": {"label": "carton", "models": ["builtin"]},
            **QUICK,
            "camera": {"photo_px": photo_px},
        },
        trimesh.creation.box((width, 200, 100)),
    )


@pytest.fixture(scope="module")
def views():
    return side_views(set_stage(box()))


def test_six_sides_are_at_one_scale_with_ground_and_bar(views):
    pictures, scale = views
    assert list(pictures) == ["+z", "-z", "-x", "+x", "+y", "-y"]
    dark = {name: (picture.min(-1) < 250) for name, picture in pictures.items()}
    seen = {name: (mask.any(0).sum(), mask.any(1).sum()) for name, mask in dark.items()}
    px = seen["+z"][0] / 300  # per millimeter
    for name, size in (("+z", (300, 200)), ("-x", (100, 200)), ("+y", (300, 100))):
        assert np.allclose(seen[name], np.array(size) * px, atol=2.5), name
    assert scale["bar_mm"] == 100 and scale["bar_px"] == pytest.approx(100 * px, rel=0.02)
    assert scale["ground_px"] == pytest.approx(np.flatnonzero(dark["+z"].any(1)).max() + 1, abs=1.5)


def test_the_piece_has_the_color_of_its_gap_whatever_the_light(views):
    pictures, _ = views
    middle = pictures["+z"][PICTURE_PX // 2, PICTURE_PX // 2]
    assert np.abs(middle.astype(int) - RAMP_RGB[0]).max() <= 2
    assert not (np.abs(pictures["-z"].astype(int) - RAMP_RGB[0]).max(-1) < 30).any()


def test_gaps_are_drawn_where_they_are():
    half = box(side="+x", width_mm=90, height_mm=90).placement  # the box is 100 mm deep: all of it lies
    assert half.gaps_mm.shape == (65, 65) and np.nanmax(half.gaps_mm) == half.gap_mm == pytest.approx(0, abs=1e-9)
    over = box(offset_mm=[120, 0]).placement  # from 75 to 165 mm, the object ends at 150: a sixth has nothing under it
    colors = gap_colors(over)
    nothing = (colors == NO_SURFACE_RGB).all(-1)
    assert nothing.mean() == pytest.approx(over.overhang_share) == pytest.approx(1 / 6, abs=0.02)
    assert nothing[:, -5:].all() and not nothing[:, :50].any()  # on the right as one faces it
    assert gap_limit_mm(over.size_mm) == pytest.approx(0.15 * 90)


@pytest.mark.parametrize(("most", "length"), [(100, 100), (99, 50), (21, 20), (1.99, 1), (0.5, 0.5)])
def test_bars_are_round(most, length):
    assert round_length(most) == pytest.approx(length)


def test_a_side_is_the_one_that_faces_so():
    assert side_of(np.array([0.1, -0.9, 0.2])) == "-y" and side_of(np.array([0.1, 0.2, 0.9])) == "+z"


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """The preview of a carton."""
    folder = tmp_path_factory.mktemp("preview")
    (folder / "scene.toml").write_text(
        '[object]\nmesh = "primitive:carton"\nlength_mm = 300\nup = "y"\n[patch]\nside = "+z"\nwidth_mm = 90\n'
        'height_mm = 90\n[target]\nlabel = "carton"\nmodels = ["builtin"]\n[camera]\nphoto_px = [400, 300]\n'
    )
    return preview_scene(folder / "scene.toml", folder / "out"), folder


def test_a_page_shows_sides_piece_and_eight_views_with_labels(shown):
    preview, folder = shown
    html = (folder / "out" / PAGE).read_text(encoding="utf-8")
    assert html.count("<figcaption>") == 6 + 8 and html.count("mm: too much") == 1
    assert "front (+z): <b>the piece hangs here</b>" in html
    assert html.count("piece hangs here") == 1 and html.count('x1="8" x2="312"') == 4  # upright sides have a ground
    assert html.count("<ol") == 8 and html.count("<li>") == 40 and html.count("<polygon") > 0
    assert re.search(r'builtin: "carton" recognized in \d of 8 views of the bare object', preview.lines[-1])
    assert preview.refused is None and 'class="note refused"' not in html


def test_a_page_asks_nobody_for_anything(shown):
    _, folder = shown
    html = (folder / "out" / PAGE).read_text(encoding="utf-8")
    assert "default-src 'none'" in html and "img-src data:" in html
    assert not re.findall(r'(?:src|href)="(?!data:)', html) and "http" not in html.replace("http-equiv", "")


def test_a_piece_that_is_refused_is_said_beside_the_bare_object(tmp_path, monkeypatch, capsys):
    """By the command line, which says where the page is and ends with what was refused; so is what was said of a
    network.
    """
    monkeypatch.chdir(tmp_path)

    def load_oddly(*given):
        warnings.warn("the network is odd", stacklevel=2)
        return load_classifier(*given)

    monkeypatch.setattr("patchproof.app.begin.preview.load_classifier", load_oddly)
    assert command("new", "primitive:carton", "--length-mm", 300) == 0
    assert "next: patchproof preview scene.toml" in capsys.readouterr().out
    text = Path("scene.toml").read_text(encoding="utf-8") + "[camera]\nphoto_px = [400, 300]\n"
    text = text.replace("width_mm = ", "width_mm = 9").replace('label = "carton"', 'label = "cartoon"')
    Path("scene.toml").write_text(text, encoding="utf-8")
    assert command("preview", "scene.toml") == 1
    said = capsys.readouterr()
    refused = said.err.splitlines()[-1]
    assert "warning: the network is odd" in said.err
    assert "page: patchproof-preview/preview.html" in said.out
    assert (
        refused.startswith("Expected a piece no larger than the object's side") and 'did you mean "carton"' in refused
    )
    html = Path("patchproof-preview", PAGE).read_text(encoding="utf-8")
    assert "the network is odd" in html
    assert html.count('class="note refused"') == 2 and "piece hangs here" not in html and html.count("<ol") == 8
    with pytest.raises(Refused, match="add --overwrite"):
        preview_scene("scene.toml", "patchproof-preview")


def test_a_piece_that_no_sheet_could_hold_is_refused_before_the_first_step_and_by_its_preview():
    """A design is printed with 2 pixels a millimeter or more, and a manifest holds 2,048 a side."""
    settings = {
        "object": {"mesh": "primitive:carton", "length_mm": 4000, "up": "y"},
        "patch": {"width_mm": 1100, "height_mm": 800},
        "target": {"label": "carton", "models": ["builtin"]},
        "view": {"distance_mm": [9000, 9000]},
        "sheet": {"template": "a3_tiles"},
    }
    scene = make_scene(settings)
    with pytest.raises(Refused, match=r"at most 2048 pixels along its longer side, got 2\d+ for 1100 × 800 mm"):
        set_problem(scene)
    assert "at most 2048 pixels" in (_unprintable(scene, 96) or "")
    assert _unprintable(make_scene(settings | {"patch": {"width_mm": 500, "height_mm": 500}}), 96) is None


@pytest.mark.parametrize(
    ("said", "label"), [("mug", "coffee mug"), ("Coffee_Mug", "coffee mug"), ("cup", "cup"), ("dustcart", LABELS[2])]
)
def test_labels_are_found_by_their_words(said, label):
    assert guess_label(LABELS, said, "thing.glb") in (label, label.split(",")[0])


def test_words_of_several_labels_or_none_are_refused():
    with pytest.raises(Refused, match='"truck", which is in 2 labels: choose "garbage truck", "tow truck"'):
        guess_label(LABELS, "truck", "thing.glb")
    with pytest.raises(Refused, match='did you mean "cup"'):
        guess_label(LABELS, "cupp", "thing.glb")


def test_a_file_is_called_what_it_shows_or_a_label_is_asked_for():
    assert guess_label(LABELS, None, "/a/b/mug_mujoco.v2.glb") == "coffee mug"
    with pytest.raises(Refused, match='got "gz truck", which no label of the network is: add --label'):
        guess_label(LABELS, None, "gz_truck_3.glb")


@pytest.fixture(scope="module")
def bottles(tmp_path_factory):
    """A cylinder of 80 × 250 mm that stands along y, in meters, in four formats, and one that lies."""
    folder = tmp_path_factory.mktemp("bottles")
    standing = trimesh.creation.cylinder(0.04, 0.25, sections=64)
    lying = standing.copy()
    standing.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    for suffix in ("glb", "obj", "stl", "ply"):
        standing.export(folder / f"bottle.{suffix}")
    lying.export(folder / "lying.glb")
    return folder


def test_gltf_is_y_up_and_in_meters_by_its_standard(bottles):
    axis, _, doubt = guess_up(bottles / "bottle.glb")
    assert (axis, doubt) == ("y", None) and guess_length_mm(bottles / "bottle.glb") == 250
    axis, _, doubt = guess_up(bottles / "lying.glb")
    assert axis == "y" and re.search(r'covers 1\d% of its footprint, with "z" up 7[789]%', doubt)


def test_a_habit_gives_way_to_how_the_object_stands(bottles):
    assert guess_up(bottles / "bottle.obj")[0] == "y"
    axis, reason, doubt = guess_up(bottles / "bottle.stl")
    assert axis == "y" and doubt is None and "as it stands" in reason


@pytest.mark.parametrize("suffix", ["obj", "stl", "ply"])
def test_a_file_without_units_asks_for_a_length(bottles, suffix):
    with pytest.raises(Refused, match="no units: add --length-mm"):
        guess_length_mm(bottles / f"bottle.{suffix}")


def test_a_file_without_units_says_how_long_it_is_in_its_own(tmp_path):
    trimesh.creation.box((300, 200, 100)).export(tmp_path / "carton.stl")
    with pytest.raises(Refused, match="longest extent: 300 if it is in mm"):
        guess_length_mm(tmp_path / "carton.stl")


@pytest.fixture(scope="module")
def standing(bottles):
    """The scene of the bottle that stands, and what `new` said of it."""
    path = bottles / "standing.toml"
    return path, new_scene(str(bottles / "bottle.glb"), path, models=("builtin",))


def test_an_object_that_may_lie_is_turned_by_one_word(tmp_path):
    """The scene has the other axis as a comment, the preview says which, `new` writes it whole."""
    path, keel = tmp_path / "scene.toml", trimesh.creation.box((0.01, 0.01, 0.25))
    keel.apply_translation([0, -0.105, 0])  # it lies on that, and flat cards lie on it
    column = trimesh.util.concatenate([trimesh.creation.box((0.12, 0.2, 0.25)), keel])
    column.export(tmp_path / "lying.glb")
    column.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    column.export(tmp_path / "standing.glb")
    bottle = {"label": "bottle", "overwrite": True, "models": ("builtin",)}
    lines = new_scene(str(tmp_path / "lying.glb"), path, **bottle)
    assert "write the scene again with --up z" in lines[0] and load_scene_settings(path).object.up == "y"
    text = path.read_text(encoding="utf-8") + "[camera]\nphoto_px = [400, 300]\n[background]\ncolor = [0.5, 0.5, 0.5]\n"
    path.write_text(re.sub(r'(?m)^up = "y".*\n# (up = "z")', r"\1", text), encoding="utf-8")
    turned = load_scene(path)
    assert np.argmax(np.ptp(turned.mesh.vertices, axis=0)) == 1 and not _up_warning(turned, turned.settings)
    path.write_text(text, encoding="utf-8")
    (warning,) = [each for each in preview_scene(path, tmp_path / "a").warnings if "may be lying" in each]
    assert warning.endswith('write up = "z" in [object]')
    lines = new_scene(str(tmp_path / "lying.glb"), path, up="z", **bottle)
    assert lines[0] == 'up: "z", as given' and "# up" not in path.read_text(encoding="utf-8")
    new_scene(str(tmp_path / "standing.glb"), tmp_path / "standing.toml", **bottle)
    assert load_scene_settings(path).patch == load_scene_settings(tmp_path / "standing.toml").patch


def test_a_side_is_preferred_to_a_top_that_is_not_twice_as_large(tmp_path):
    for name, size, side in (("low", (0.3, 0.1, 0.3), "+y"), ("high", (0.225, 0.17, 0.3), "+z")):
        trimesh.creation.box(size).export(tmp_path / f"{name}.glb")
        new_scene(str(tmp_path / f"{name}.glb"), tmp_path / f"{name}.toml", label="carton")
        assert load_scene_settings(tmp_path / f"{name}.toml").patch.side == side
    assert "of the camera to left and right of straight above" in (tmp_path / "low.toml").read_text(encoding="utf-8")


def test_a_name_that_is_no_label_is_answered_with_the_labels_where_they_are_few():
    with pytest.raises(Refused, match='add --label with what it is to be recognized as: "lamp", "vase"'):
        guess_label(("lamp", "vase"), None, "lantern.glb")
    with pytest.raises(Refused, match=r"recognized as[.]$"):
        guess_label([f"thing {i}" for i in range(21)], None, "lantern.glb")


def test_photographs_beside_two_blanks_ask_which_one_hangs_there(tmp_path):
    (tmp_path / "photos").mkdir()
    for name in ("one", "two"):
        blank_page(tmp_path / f"{name}.pdf", template="blank_a4")
    with pytest.raises(Refused, match=r"one blank sheet's JSON, got one[.]json, two[.]json"):
        new_scene(str(tmp_path / "photos"), tmp_path / "scene.toml")


def test_a_length_that_makes_no_sense_is_refused(tmp_path):
    for length_m, name in ((6, "van.glb"), (6.1, "hall.glb"), (12.3, "mug.glb")):
        trimesh.creation.box((length_m, 0.1, 0.1)).export(tmp_path / name)
    assert guess_length_mm(tmp_path / "van.glb") == 6000
    for name, length in (("hall", 6100), ("mug", 12300)):
        with pytest.raises(Refused, match=rf"to 6 m, got {length} mm by the units of {name}.glb: add --length-mm"):
            guess_length_mm(tmp_path / f"{name}.glb")


def test_a_box_stands_on_all_of_its_footprint():
    assert footing(trimesh.creation.box((3, 2, 1)).vertices) == pytest.approx(1)
    assert footing(np.array([[0.0, 0, 0], [1, 1, 0], [0, 1, 1]])) == 0  # on a point


def test_the_largest_piece_is_found_between_those_that_fit():
    assert largest_fitting_size((100, 50), lambda size: size[0] <= 80, 20) == pytest.approx((79, 39), abs=1.5)
    assert largest_fitting_size((100, 50), lambda size: True, 20) == (100, 50)
    assert largest_fitting_size((100, 50), lambda size: False, 20) is None
    assert largest_fitting_size((100, 50), lambda size: True, 51) is None
    assert largest_fitting_size((100, 0), lambda size: True, 20) is None


@pytest.mark.parametrize(("up", "side"), [("y", "+z"), ("z", "+y")])
def test_a_sign_of_one_quad_gets_its_piece_on_its_face(up, side, tmp_path):
    (tmp_path / "sign.obj").write_text("v -3 -2 0\nv 3 -2 0\nv 3 2 0\nv -3 2 0\nf 1 2 3 4\n")
    new_scene(str(tmp_path / "sign.obj"), tmp_path / "scene.toml", label="street sign", length_mm=600, up=up)
    scene = load_scene(tmp_path / "scene.toml")
    assert (scene.settings.patch.side, scene.placement.family) == (side, "card")
    with pytest.raises(Refused, match=r"the object's side \(.*\b0\b.* mm\), got .* choose a larger side"):
        make_scene(scene.settings.changed(patch={"side": "+x"}), base=tmp_path)


def test_a_new_scene_loads_and_says_what_was_guessed(bottles, standing):
    path, lines = standing
    settings = load_scene_settings(path)
    assert (settings.object.length_mm, settings.object.up, settings.target.label) == (250, "y", "bottle")
    assert settings.view.distance_mm == (380, 680) and settings.patch.bend and settings.patch.side == "+z"
    assert lines[0] == 'up: "y", glTF\'s standard' and "by the file's units" in lines[1]
    scene = load_scene(path)
    assert scene.placement.family == "cylinder" and scene.placement.gap_mm < 1
    assert 39 <= min(scene.piece.size_mm) <= 80 * 0.7
    with pytest.raises(Refused, match="add --overwrite"):
        new_scene(str(bottles / "bottle.glb"), path)


def test_a_new_scene_of_a_primitive_has_a_flat_card_where_one_will_do(tmp_path):
    new_scene("primitive:carton", tmp_path / "scene.toml", length_mm=300)
    patch = load_scene_settings(tmp_path / "scene.toml").patch
    assert not patch.bend and min(patch.width_mm, patch.height_mm) > 60


def test_what_cannot_be_optimized_is_not_written(tmp_path):
    path = tmp_path / "scene.toml"
    with pytest.raises(Refused, match="room for a piece of 39 mm, got an object of 30 mm"):
        new_scene("primitive:carton", path, length_mm=30)
    (tmp_path / "things").mkdir()
    with pytest.raises(Refused, match="a CSV of labels among images, or a blank sheet's JSON"):
        new_scene(str(tmp_path / "things"), path)
    for given in ({"length_mm": 30}, {"up": "z"}):
        with pytest.raises(Refused, match="pictures have no length and no axes"):
            new_scene(str(tmp_path / "things"), path, **given)
    with pytest.raises(Refused, match="no file at"):
        new_scene(str(tmp_path / "mug.glb"), path)
    assert not path.exists()


def test_a_new_scene_of_images_takes_their_most_frequent_label(tmp_path):
    from PIL import Image

    folder = tmp_path / "images"
    folder.mkdir()
    rows = ["file,label"]
    for i, label in enumerate(["mug", "carton", "carton"]):
        pixels = np.random.default_rng(i).integers(0, 256, (64, 64, 3), np.uint8)
        Image.fromarray(pixels).save(folder / f"{i}.png")
        rows.append(f"{i}.png,{label}")
    (folder / "labels.csv").write_text("\n".join(rows))
    new_scene(str(folder), tmp_path / "scene.toml")
    settings = load_scene_settings(tmp_path / "scene.toml")
    assert settings.target.label == "carton" and settings.object.images == "images"
    preview = preview_scene(tmp_path / "scene.toml", tmp_path / "out")
    html = (tmp_path / "out" / PAGE).read_text(encoding="utf-8")
    assert preview.refused is None and html.count("<ol") == 8 and "Turn it" not in html


def test_a_table_of_indices_gives_a_scene_its_index_and_no_preview_erased_boxes(tmp_path):
    from PIL import Image

    folder = tmp_path / "images"
    folder.mkdir()
    for i in range(3):
        Image.new("RGB", (64, 64), (90, 90, 90)).save(folder / f"{i}.png")
    (folder / "labels.csv").write_text("filename,label\n0.png,7\n1.png,7\n2.png,0")
    for label in (None, "carton"):
        new_scene(str(folder), tmp_path / "scene.toml", label=label, models=("builtin",), overwrite=True)
        assert load_scene_settings(tmp_path / "scene.toml").target.label == 7
    text = (tmp_path / "scene.toml").read_text().replace("label = 7", 'label = "carton"')
    (tmp_path / "named.toml").write_text(text)
    with pytest.raises(Refused, match=r'got 3 images with other .*: write the index of "carton" as target.label'):
        load_scene(tmp_path / "named.toml")
    stage = set_stage(load_scene(tmp_path / "scene.toml"))
    assert all(np.ptp(look["picture"]) < 60 for look in sample_views(stage, [load_classifier("builtin")], [(7,)]))


def test_a_preview_of_a_texture_says_how_many_texels_a_mask_is_drawn_for(tmp_path):
    (tmp_path / "scene.toml").write_text(
        '[object]\nmesh = "primitive:mailbox"\nlength_mm = 300\n[patch]\nkind = "masked"\nmaterials = ["body"]\n'
        '[target]\nlabel = "mailbox"\nmodels = ["builtin"]\n[camera]\nphoto_px = [96, 96]\n'
    )
    found = preview_scene(tmp_path / "scene.toml", tmp_path / "out")
    (line,) = (line for line in found.lines if line.startswith("texture: "))
    assert re.fullmatch(r'texture: "body", 1024 × 1024 texels, of which \d+% may change', line)


def test_a_piece_without_a_place_is_left_off_where_it_would_not_lie(tmp_path):
    scene = {
        "object": {"mesh": "primitive:mug", "length_mm": 100, "up": "y"},
        "patch": {"width_mm": 45, "height_mm": 45, "place": "auto", "side": "+z"},
        "target": {"label": "mug", "models": ["builtin"]},
        **QUICK,
    }
    lines = [f"{name} = {json.dumps(table).replace(':', ' =')}" for name, table in scene.items()]
    text = "\n".join(re.sub(r'"(\w+)" =', r"\1 =", line) for line in lines).replace("primitive =", "primitive:")
    (tmp_path / "scene.toml").write_text(text)
    preview = preview_scene(tmp_path / "scene.toml", tmp_path / "out")
    assert any(line.startswith('place: "auto": optimize searches') for line in preview.lines)
    html = (tmp_path / "out" / PAGE).read_text(encoding="utf-8")
    assert "piece hangs here" not in html and "piece: not placed" in preview.lines


def test_no_page_scrolls_sideways_cuts_anything_or_runs_anything(shown, tmp_path):
    path = shown[1] / "out" / PAGE
    assert path.stat().st_size < 400_000 and "<script" not in path.read_text(encoding="utf-8")
    with Browser(tmp_path) as browser:
        for width_px in (1280, 390):
            looks = browser.look_at(path, width_px)
            assert looks["inner"] == width_px and looks["width"] <= width_px and looks["wide"] == []
            assert looks["broken"] == looks["small"] == 0 and looks["errors"] == looks["fetched"] == []


@pytest.mark.parametrize(
    ("patch", "advice"),
    [
        ({"height_mm": 900}, r"; 90 × \d\d\d mm lies well there; place = \"auto\" searches for a place$"),
        ({"offset_mm": [400, 0]}, r"change offset_mm or at_mm; place = \"auto\" searches for a place$"),
        ({"side": "+x", "width_mm": 120}, r"; 100 × 90 mm lies well there; place"),
        ({"side": "+x", "width_mm": 350, "height_mm": 350}, r"; 100 × 200 mm lies well there; place"),
        ({"side": "+x", "width_mm": 900, "height_mm": 12}, "or choose a larger side; place"),
    ],
)
def test_a_refused_piece_is_told_what_would_fit(patch, advice):
    with pytest.raises(Refused) as refused:
        box(**patch)
    assert re.search(advice, str(refused.value).rstrip(".")), refused.value


def test_markers_say_what_asks_for_their_size():
    sharp = {"photo_px": (1600, 1200)}
    (note,) = [note for note in box(width_mm=45, height_mm=45, **sharp).warnings if "too small" in note]
    needed, least = re.search(r"camera.photo_px ask for ([\d.]+) mm, and those for a piece of (\d+) mm", note).groups()
    enough = box(width_mm=int(least), height_mm=int(least), **sharp)
    assert not [note for note in enough.warnings if "too small" in note]
    assert float(needed) == pytest.approx(enough.piece.marker_mm, abs=0.06)
