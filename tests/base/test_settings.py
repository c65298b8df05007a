"""Settings are strict: each mistake in a scene file is refused in one sentence that names it."""

import math
import re
from pathlib import Path

import pytest

from patchproof.base import packaged
from patchproof.base.errors import Refused
from patchproof.base.fingerprint import content_identity
from patchproof.base.goal import Goal
from patchproof.base.packaged import packaged_path
from patchproof.base.settings import SceneSettings, identity_settings, load_scene_settings
from patchproof.base.validation import StrictModel, expand_path, spelling_hint, validate_model
from patchproof.sheets.manifest import Target

SCENE = """
[object]
mesh = "primitive:mug"
length_mm = 100
[patch]
width_mm = 40
height_mm = 30
[target]
label = "jeep"
models = ["builtin"]
"""


def scene(tmp_path, *changes: tuple[str, str], extra: str = "") -> Path:
    text = SCENE
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (tmp_path / "scene.toml").write_text(text + extra)
    return tmp_path / "scene.toml"


def refusal(path) -> str:
    with pytest.raises(Refused) as error:
        load_scene_settings(path)
    text = str(error.value)
    assert text.startswith("Expected ") and ", got " in text and text.endswith(".") and "\n" not in text
    return text


def test_the_shortest_scene_has_the_documented_defaults(tmp_path):
    read = load_scene_settings(scene(tmp_path))
    assert read.object.up == "z" and read.patch.side == "+x" and read.sheet.template == "a4"
    assert read.view.azimuth_deg == (-60, 60) and read.camera.jpeg == (60, 95) and read.printer.profile == "office"
    assert (read.optimize.steps, read.optimize.views, read.target.goal) == (240, 4, "assist")
    with pytest.raises(Exception, match="frozen"):
        read.object.up = "y"


def test_a_number_may_be_a_label(tmp_path):
    assert load_scene_settings(scene(tmp_path, ('"jeep"', "609"))).target.label == 609


def test_an_unknown_key_names_the_nearest(tmp_path):
    assert 'got "patch.widht_mm": did you mean "width_mm"' in refusal(scene(tmp_path, ("width_mm", "widht_mm")))
    assert 'did you mean "camera"' in refusal(scene(tmp_path, extra="[camrea]\nnoise = [0, 0]\n"))
    assert "use one of: object, patch" in refusal(scene(tmp_path, extra="[qqq]\nx = 1\n"))


def test_an_unknown_key_inside_lists_and_optional_tables_is_refused_too():
    class Inner(StrictModel):
        width: int = 0

    class Outer(StrictModel):
        rows: tuple[Inner, ...] = ()
        named: dict[str, Inner] | None = None
        maybe: Inner | None = None

    wrong = {"widht": 1}
    for data in ({"rows": [wrong]}, {"named": {"a": wrong}}, {"maybe": wrong}):
        with pytest.raises(Refused, match='widht": did you mean "width"'):
            validate_model(Outer, data, "file")


def test_a_missing_key_is_named(tmp_path):
    text = refusal(scene(tmp_path, ('label = "jeep"\n', "")))
    assert '"target.label"' in text and "add target.label" in text
    assert '"target"' in refusal(scene(tmp_path, ('[target]\nlabel = "jeep"\nmodels = ["builtin"]\n', "")))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            'models = ["builtin"]',
            'models = "builtin"',
            r"target\.models.*got 'builtin': .* a list in square brackets\.$",
        ),
        ('models = ["builtin"]', "models = []", r"got \[\]: list should have at least 1 item, not 0\.$"),
        ('label = "jeep"', "label = 478.0", r'"target\.label".*got 478\.0: .* text in quotes or a valid integer\.$'),
        ("height_mm = 30", "height_mm = 30\nbend = 1.5", r'"patch\.bend".*got 1\.5: .* true or false'),
        (
            "height_mm = 30",
            "height_mm = 30\noffset_mm = [3]",
            r"got \[3\]: patch\.offset_mm needs at least 2 values\.$",
        ),
    ],
)
def test_a_value_of_another_kind_is_refused_in_words_of_the_file(tmp_path, old, new, sentence):
    assert re.search(sentence, refusal(scene(tmp_path, (old, new))))


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("length_mm = 100", "", 'usable "object".*object takes length_mm together with mesh'),
        ('mesh = "primitive:mug"\n', "", 'usable "object".*object takes one of mesh, photos or images'),
        ("length_mm = 100", 'length_mm = 100\nphotos = "p"\nsheet = "s"', "object takes one of mesh, photos or images"),
        ('mesh = "primitive:mug"\nlength_mm = 100', 'photos = "p"', "object takes sheet together with photos"),
        ('mesh = "primitive:mug"\nlength_mm = 100', 'images = "p"', "object takes labels together with images"),
        ("height_mm = 30\n", "", "patch takes width_mm and height_mm together"),
        ("width_mm = 40\nheight_mm = 30\n", "", r"got a contradiction: add patch\.width_mm and patch\.height_mm\.$"),
        ("height_mm = 30", "height_mm = 30\nepsilon = 0.1", "epsilon with textures only"),
        ("height_mm = 30", 'height_mm = 30\nkind = "masked"', "one of mask, materials or faces"),
        ("height_mm = 30", 'height_mm = 30\nmask = "m.png"', 'mask with kind = "masked" only'),
        ("height_mm = 30", 'height_mm = 30\nkind = "texture"\nbend = true', "bend with patches only"),
    ],
)
def test_keys_that_go_together_are_named(tmp_path, old, new, sentence):
    assert re.search(sentence, refusal(scene(tmp_path, (old, new))))


def test_a_texture_needs_a_mesh(tmp_path):
    changes = (
        ('mesh = "primitive:mug"\nlength_mm = 100', 'images = "p"\nlabels = "l"'),
        ("[patch]", '[patch]\nkind = "texture"'),
    )
    assert 'name object.mesh, or leave out patch.kind = "texture"' in refusal(scene(tmp_path, *changes))


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "0", "-5", '"wide"'])
def test_lengths_are_finite_positive_numbers(tmp_path, value):
    assert "length_mm" in refusal(scene(tmp_path, ("length_mm = 100", f"length_mm = {value}")))


@pytest.mark.parametrize(
    "line",
    [
        "[view]\nazimuth_deg = [60, -60]",
        "[view]\nazimuth_deg = [nan, 60]",
        "[view]\nazimuth_deg = [1, 2, 3]",
        "[view]\nazimuth_deg = 5",
        "[view]\nelevation_deg = [0, 90]",
        "[view]\ndistance_mm = [0, 100]",
        "[view]\nfov_deg = 170",
        "[view]\nfov_deg = 0.0001",
        "[view]\nlook_at = 'sky'",
        "[light]\nambient = [-0.1, 0.5]",
        "[camera]\nphoto_px = [16, 1200]",
        "[camera]\njpeg = [0, 95]",
        "[camera]\njpeg = [95, 60]",
        "[camera]\nnoise = [0, 1.5]",
        "[camera]\nwhite_balance = 0.6",
        "[background]\ncolor = [0.5, 0.5, 1.1]",
        "[background]\nimages = 'x'\ncolor = [0.5, 0.5, 0.5]",
        "[light]\ndirectional = [1, 0.5]",
        "[camera]\nmotion_px = [-1, 2]",
        "[optimize]\nviews = 0",
        "[view]\npatch_share = [0.1, 1.2]",
        "[optimize]\nsteps = 0",
        "[optimize]\nseed = -1",
        "[optimize]\nseed = 4294967296",
        "[optimize]\nseed = 99999999999999999999",
        "[optimize]\nsteps = 1.5",
        "[view]\ndistance_mm = [true, 500]",
        "[view]\ndistance_mm = ['440', 500]",
        "[optimize]\noptimizer = 'sgd'",
    ],
)
def test_each_wrong_value_is_refused_by_its_key(tmp_path, line):
    text = refusal(scene(tmp_path, extra=line + "\n"))
    table, key = line.split("]")[0][1:], line.split("\n")[1].split(" =")[0]
    assert table in text and (key in text or table == "background")


def test_a_reversed_range_says_both_ends(tmp_path):
    assert "[low, high] with low <= high, not [60, -60]" in refusal(
        scene(tmp_path, extra="[view]\nazimuth_deg = [60, -60]\n")
    )


def test_a_side_that_is_none_is_told_which_there_are(tmp_path):
    text = refusal(scene(tmp_path, extra='[view]\nfront = "top"\n'))
    assert 'a usable "view.front" in' in text and "'patch', '+x', '-x', '+y', '-y', '+z' or '-z'" in text


def test_a_scene_without_any_light_is_refused(tmp_path):
    dark = "[light]\nambient = [0, {}]\ndirectional = [0, 0]\n"
    assert "raise light.ambient or light.directional: every" in refusal(scene(tmp_path, extra=dark.format(0)))
    assert load_scene_settings(scene(tmp_path, extra=dark.format(0.1))).light.ambient == (0, 0.1)


def test_no_models_are_refused(tmp_path):
    assert "target.models" in refusal(scene(tmp_path, ('["builtin"]', "[]")))


def test_files_that_are_no_toml(tmp_path):
    assert "no file at" in refusal(tmp_path / "none.toml")
    (tmp_path / "a.toml").write_text("this is = = not toml")
    assert "cannot be read" in refusal(tmp_path / "a.toml")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    assert "got /" in refusal(tmp_path / "b.toml")
    assert "no file at" in refusal(tmp_path)


def test_expand_paths_and_names(tmp_path, monkeypatch):
    monkeypatch.setenv("PP_TEST_DIR", "/data")
    absolute = str(tmp_path / "x" / "car.glb")
    assert expand_path("car.glb", tmp_path / "x") == absolute and expand_path(absolute, Path("/elsewhere")) == absolute
    assert expand_path("${PP_TEST_DIR}/car.glb", tmp_path) == "/data/car.glb"
    assert expand_path("file:${PP_TEST_DIR}/net.onnx", tmp_path) == "file:/data/net.onnx"
    assert expand_path("file:net.onnx", tmp_path) == f"file:{tmp_path / 'net.onnx'}"
    assert expand_path("timm:vit@w.safetensors", tmp_path) == f"timm:vit@{tmp_path / 'w.safetensors'}"
    assert expand_path("torchvision:vgg11@/data/w.safetensors", tmp_path) == "torchvision:vgg11@/data/w.safetensors"
    kept = ("timm:hf-hub:timm/vit@main", "timm:vit@w.pth", "torchvision:resnet50", "timm:vit")
    for name in ("builtin", "primitive:mug", *kept, "module:a.b"):
        assert expand_path(name, tmp_path) == name
    monkeypatch.delenv("PP_TEST_DIR")
    with pytest.raises(Refused, match="the environment variable PP_TEST_DIR, got none"):
        expand_path("${PP_TEST_DIR}/car.glb", tmp_path)


def test_settings_keep_variables_unexpanded(tmp_path):
    read = load_scene_settings(scene(tmp_path, ('"primitive:mug"', '"${NOWHERE}/a.glb"')))
    assert read.object.mesh == "${NOWHERE}/a.glb"


def test_refused_is_one_sentence_whatever_it_is_given():
    text = str(Refused("a\n thing", "  another\tone", "do this."))
    assert text == "Expected a thing, got another one: do this." and issubclass(Refused, ValueError)


def test_nearest():
    assert spelling_hint("coatet", ["coated", "news"]) == 'did you mean "coated"'
    assert spelling_hint("zzz", ["coated", "news"]) == "use one of: coated, news"


def test_values_in_messages_are_short():
    data = {"object": {"mesh": "m", "length_mm": "9" * 500 + "x"}, "patch": {}, "target": {}}
    with pytest.raises(Refused) as error:
        validate_model(SceneSettings, data, "scene")
    assert len(str(error.value)) < 300


@pytest.mark.parametrize("folder", ["calibration", "print_templates"])
def test_shipped_data_is_found_in_checkout_and_in_package(tmp_path, monkeypatch, folder):
    assert packaged_path(folder).is_dir()
    for root in (tmp_path / "site" / "patchproof", tmp_path / "checkout" / "src" / "patchproof"):
        root.mkdir(parents=True)
        monkeypatch.setattr(packaged, "__file__", str(root / "base" / "packaged.py"))
        with pytest.raises(Refused, match=folder):
            packaged_path(folder)
        home = root if "site" in root.parts else root.parents[1]
        (home / folder / "sub").mkdir(parents=True)
        assert packaged_path(folder, "sub", "a.json") == home / folder / "sub" / "a.json"


def test_numbers_stay_numbers(tmp_path):
    read = load_scene_settings(scene(tmp_path))
    assert (
        math.isclose(read.object.length_mm, 100) and SceneSettings.model_validate_json(read.model_dump_json()) == read
    )


def test_only_what_differs_from_a_default_names_a_sheet(tmp_path):
    plain, spelled = (load_scene_settings(scene(tmp_path, extra=text)) for text in ("", "[optimize]\nsteps = 240"))
    other = load_scene_settings(scene(tmp_path, extra="[optimize]\nsteps = 241"))
    assert identity_settings(plain) == identity_settings(spelled) != identity_settings(other)


def test_a_sheet_is_named_by_what_files_hold_and_not_by_how_their_paths_are_spelled(tmp_path):
    """The printer's two files are one printer; a network, a camera and a mesh may lie anywhere."""
    (tmp_path / "inner").mkdir()
    for name, content in (("p.npz", "1"), ("p.json", "2"), ("c.json", "3"), ("n.onnx", "4"), ("m.obj", "5")):
        (tmp_path / name).write_text(content)
        (tmp_path / "inner" / name).write_text(content)

    def identity(folder: str, printer: str) -> dict:
        data = {
            "object": {"mesh": f"{folder}m.obj", "length_mm": 100},
            "patch": {"width_mm": 50, "height_mm": 50},
            "target": {"label": "red", "models": [f"file:{folder}n.onnx", "builtin"]},
            "printer": {"profile": f"{folder}{printer}"},
            "camera": {"file": f"{folder}c.json"},
        }
        return content_identity(SceneSettings.model_validate(data), tmp_path)

    first = identity("", "p.json")
    assert first == identity("inner/", "p.npz") == identity("inner/../", "p.npz") == identity(f"{tmp_path}/", "p.json")
    (tmp_path / "inner" / "p.npz").write_text("another")
    assert identity("inner/", "p.json") != first and identity("inner/", "p.json")["target"]["models"][1] == "builtin"


def test_settings_change_through_a_door_that_checks(tmp_path):
    plain = load_scene_settings(scene(tmp_path))
    changed = plain.changed(optimize={"steps": 3}, light={"ambient": (0.1, 0.2)})
    assert (changed.optimize.steps, changed.light.ambient) == (3, (0.1, 0.2))
    assert changed.changed(optimize={"steps": 240}, light={"ambient": (0.3, 0.7)}) == plain
    for wrong, named in (({"steps": -3}, "steps"), ({"stepz": 3}, 'did you mean "steps"')):
        with pytest.raises(Refused, match=named):
            plain.changed(optimize=wrong)
    with pytest.raises(Refused, match="optimice"):
        plain.changed(optimice={"steps": 3})


def test_a_goal_that_is_none_is_refused_wherever_it_stands(tmp_path):
    with pytest.raises(Refused, match="goal"):
        load_scene_settings(scene(tmp_path, ('label = "jeep"', 'label = "jeep"\ngoal = "assits"')))
    with pytest.raises(Refused, match="goal"):
        validate_model(Target, {"label": "jeep", "indices": [1], "goal": "confuse"}, "sheet.json")
    assert [(str(goal), goal.sign) for goal in Goal] == [("assist", 1), ("deceive", -1)]
