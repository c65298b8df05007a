"""The printer: its table is the chain it was baked from, its gradients are true, and broken files are refused."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch

from patchproof.base.color import LUMINANCE, ciede2000, lab_from_linear, lab_from_srgb, linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.output import write_files_atomically
from patchproof.base.packaged import packaged_path
from patchproof.base.settings import PrinterSettings
from patchproof.calibrate import icc
from patchproof.channel.printer import (
    NODES_8BIT,
    Printer,
    identity_printer,
    load_printer,
    node_colors,
    printer_contents,
    printer_from_table,
    vary_print,
)

DATA = os.environ.get("PATCHPROOF_DATA")
needs_data = pytest.mark.skipif(not DATA, reason="PATCHPROOF_DATA is unset: no ICC profiles")
PROFILES = {"coated": "FOGRA39L_coated.icc", "uncoated": "FOGRA47L_uncoated.icc"}


def image(colors) -> torch.Tensor:
    """N×3 colors as 1×3×N×1."""
    return torch.as_tensor(np.asarray(colors)).T[None, :, :, None]


def colors_of(seen: torch.Tensor) -> np.ndarray:
    return seen[0, :, :, 0].T.detach().numpy()


def random_8bit(n=2000):
    return np.random.default_rng(5).integers(0, 256, (n, 3)) / 255


# ------------------------------------------------------------------------------------------------ the table


def test_identity_changes_nothing_and_is_in_gamut():
    sent = random_8bit()
    np.testing.assert_allclose(colors_of(identity_printer().apply(image(sent))), sent, atol=1e-6)
    assert identity_printer().gamut_distance(image(sent)).abs().max() == 0


def test_nodes_are_exact_and_axes_are_red_green_blue():
    lut = np.random.default_rng(1).random((33, 33, 33, 3))
    printer = printer_from_table("noise", "assumed", lut, lut[..., 0], {})
    i, j, k = np.random.default_rng(2).integers(0, 33, (3, 500))
    sent = np.array(NODES_8BIT)[np.stack([i, j, k], 1)] / 255
    np.testing.assert_allclose(colors_of(printer.apply(image(sent))), lut[i, j, k], atol=1e-6)
    np.testing.assert_allclose(colors_of(printer.gamut_distance(image(sent)))[:, 0], lut[i, j, k, 0], atol=1e-6)


def test_trilinear_twin():
    from scipy.interpolate import RegularGridInterpolator

    lut = np.random.default_rng(1).random((33, 33, 33, 3))
    sent = np.random.default_rng(3).random((2000, 3))
    slow = RegularGridInterpolator((np.array(NODES_8BIT) / 255,) * 3, lut)(sent)
    fast = colors_of(printer_from_table("noise", "assumed", lut, lut[..., 0], {}).apply(image(sent)))
    np.testing.assert_allclose(fast, slow, atol=1e-5)


def test_images_of_a_batch_do_not_mix():
    batch = torch.rand(3, 3, 5, 7, generator=torch.Generator().manual_seed(0))
    printer = load_printer("coated")
    together = printer.apply(batch)
    assert together.shape == batch.shape and printer.gamut_distance(batch).shape == (3, 1, 5, 7)
    for i in range(3):
        torch.testing.assert_close(together[i : i + 1], printer.apply(batch[i : i + 1]))


def test_input_is_clamped_and_type_kept():
    sent = torch.tensor([-0.5, 0.5, 1.5]).reshape(1, 3, 1, 1)
    printer = load_printer("coated")
    torch.testing.assert_close(printer.apply(sent), printer.apply(sent.clamp(0, 1)))
    assert printer.apply(sent.half()).dtype == torch.float16 and printer.apply(sent.double()).dtype == torch.float64


def test_gradients_are_true_inside_and_alive_at_black_and_white():
    printer = load_printer("coated")
    inside = torch.tensor([[0.37, 0.52, 0.61], [0.11, 0.86, 0.23]], dtype=torch.float64).T[None, :, :, None]
    inside.requires_grad_(True)
    assert torch.autograd.gradcheck(printer.apply, (inside,), eps=1e-5)
    assert torch.autograd.gradcheck(printer.gamut_distance, (inside,), eps=1e-5)
    for corner in (0.0, 1.0):
        edge = torch.full((1, 3, 1, 1), corner, dtype=torch.float64, requires_grad=True)
        printer.apply(edge).sum().backward()
        step = (1 - 2 * corner) * 1e-6
        slope = (printer.apply(edge.detach() + step) - printer.apply(edge.detach())).sum() / step
        assert edge.grad.sum().item() == pytest.approx(slope.item(), rel=1e-3) and edge.grad.abs().min() > 0.01


@pytest.mark.parametrize("name", PROFILES)
def test_shipped_printers_leave_paper_white_and_lift_black(name):
    printer = load_printer(name)
    seen = colors_of(printer.apply(image([[1.0, 1, 1], [0, 0, 0]])))
    np.testing.assert_allclose(seen[0], 1, atol=1e-6)
    low, high = (8, 16) if name == "coated" else (23, 31)  # coated and plain paper, print_color facts
    assert low < printer.paper.black_L < high
    assert printer.paper.black_L == pytest.approx(float(lab_from_srgb(seen[1].astype(float))[0]), abs=0.05)
    assert printer.method == "icc" and printer.provenance["licence"] == "CC0"
    assert printer.paper.white_lab == pytest.approx((95, 0, -2), abs=0.2)


@pytest.mark.parametrize("name", PROFILES)
def test_shipped_files_are_small_and_their_errors_within_bounds(name):
    assert packaged_path("calibration", "printers", f"{name}.npz").stat().st_size < 150_000
    error = load_printer(name).provenance["delta_e00_to_exact_chain"]
    assert error["mean"] <= 0.25 and error["p95"] <= 0.5 and error["max"] <= 2.0 and error["colors"] == 10_000


def test_gamut_distance_is_the_round_trip():
    printer = load_printer("coated")
    nodes = torch.tensor(node_colors().reshape(-1, 3).T[None, :, :, None])
    seen = colors_of(printer.apply(nodes))
    expected = ciede2000(lab_from_srgb(node_colors().reshape(-1, 3)), lab_from_srgb(seen))
    np.testing.assert_allclose(colors_of(printer.gamut_distance(nodes))[:, 0], expected, atol=0.07)  # kept in eighths
    vivid, dull = colors_of(printer.gamut_distance(image([[0.0, 1, 0], [0.5, 0.5, 0.5]])))[:, 0]
    assert vivid > 8 and dull < 1.5


# ------------------------------------------------------------------------------------------------ baking


@needs_data
@pytest.mark.parametrize("name", PROFILES)
def test_the_table_follows_the_exact_chain(name):
    """Pillow's own proof transform, asked anew, with other colors than those the bake checked itself on."""
    from PIL import Image, ImageCms

    srgb, relative = ImageCms.createProfile("sRGB"), ImageCms.Intent.RELATIVE_COLORIMETRIC
    flags = ImageCms.Flags.SOFTPROOFING | ImageCms.Flags.NOOPTIMIZE | ImageCms.Flags.NOCACHE
    path = str(Path(DATA) / "icc" / PROFILES[name])
    chain = ImageCms.buildProofTransform(srgb, srgb, path, "RGB", "RGB", relative, relative, flags=flags)
    sent = np.random.default_rng(77).integers(0, 256, (1, 10_000, 3), dtype=np.uint8)
    exact = np.asarray(ImageCms.applyTransform(Image.fromarray(sent), chain))[0] / 255
    error = ciede2000(lab_from_srgb(exact), lab_from_srgb(colors_of(load_printer(name).apply(image(sent[0] / 255)))))
    assert error.mean() <= 0.25 and np.percentile(error, 95) <= 0.5 and error.max() <= 2.0


@needs_data
def test_baking_gives_the_shipped_bytes_twice(tmp_path):
    profile = Path(DATA) / "icc" / PROFILES["coated"]
    for folder in ("a", "b"):
        write_files_atomically(printer_contents(icc.bake(profile, "coated"), tmp_path / folder / "coated.npz"))
    for suffix in (".npz", ".json"):
        one, two = ((tmp_path / f / f"coated{suffix}").read_bytes() for f in "ab")
        assert one == two
    head = json.loads((tmp_path / "a" / "coated.json").read_text())
    assert head["provenance"]["profile_sha256"] == hashlib.sha256(profile.read_bytes()).hexdigest()
    torch.testing.assert_close(load_printer(str(tmp_path / "a" / "coated.npz")).lut, load_printer("coated").lut)


def refused_profile(path, *words):
    with pytest.raises(Refused) as error:
        icc.bake(path, "x")
    text = str(error.value)
    assert "\n" not in text and all(word in text for word in words), text


def test_profiles_that_are_none(tmp_path):
    refused_profile(tmp_path / "none.icc", "no file at")
    (tmp_path / "a.icc").write_text("hello " * 100)
    refused_profile(tmp_path / "a.icc", "which does not begin with a profile's header")
    with open(tmp_path / "big.icc", "wb") as file:
        file.truncate(100 * 2**20)  # sparse: takes no room
    refused_profile(tmp_path / "big.icc", "102400 KiB, more than 32768 KiB")


def test_a_display_profile_is_no_printer(tmp_path):
    from PIL import ImageCms

    (tmp_path / "srgb.icc").write_bytes(ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes())
    refused_profile(tmp_path / "srgb.icc", "class mntr with RGB")


@needs_data
def test_cut_and_gutted_profiles(tmp_path):
    data = (Path(DATA) / "icc" / PROFILES["coated"]).read_bytes()
    (tmp_path / "cut.icc").write_bytes(data[: len(data) // 2])
    refused_profile(tmp_path / "cut.icc", "whole ICC profile", f"{len(data) // 2} of {len(data)} bytes")
    for tag in (b"A2B0", b"A2B1", b"A2B2", b"B2A0", b"B2A1", b"B2A2"):  # header intact, no way to or from the printer
        data = data.replace(tag, b"none", 1)
    (tmp_path / "gutted.icc").write_bytes(data)
    refused_profile(tmp_path / "gutted.icc", "gutted.icc")


# ------------------------------------------------------------------------------------------------ files


def test_saving_and_loading_keep_a_measured_printer(tmp_path):
    lut = np.random.default_rng(1).random((33, 33, 33, 3))
    printer = printer_from_table("mine", "measured", lut, 30 * lut[..., 0], {"chart": "a4"})
    write_files_atomically(printer_contents(printer, tmp_path / "mine.npz"))
    again = load_printer("mine.npz", tmp_path)
    torch.testing.assert_close(again.lut, printer.lut, atol=1e-5, rtol=0)  # 16 bits
    torch.testing.assert_close(again.gamut, printer.gamut, atol=0.063, rtol=0)  # eighths
    assert (again.name, again.method, again.paper, again.provenance) == (
        "mine",
        "measured",
        printer.paper,
        {"chart": "a4"},
    )
    torch.testing.assert_close(load_printer(str(tmp_path / "mine.json")).lut, again.lut)


def test_tables_outside_srgb_are_clipped():
    printer = printer_from_table("wide", "assumed", node_colors() * 1.2 - 0.1, np.zeros((33, 33, 33)), {})
    assert printer.lut.min() == 0 and printer.lut.max() == 1


def test_unknown_names_say_the_nearest():
    with pytest.raises(Refused, match='got "coatet": did you mean "coated"'):
        load_printer("coatet")
    with pytest.raises(Refused, match="coated, office, uncoated, identity"):
        load_printer("x")
    with pytest.raises(Refused, match="no file at"):
        load_printer("folder/none.npz")
    with pytest.raises(Refused, match="calibrate printer"):
        load_printer("mine.icc")


def hostile(arrays, path):
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    "break_it",
    [
        lambda npz: npz.write_bytes(npz.read_bytes()[:5000]),
        lambda npz: npz.write_bytes(b""),
        lambda npz: npz.write_text("hello"),
        lambda npz: hostile({"lut": np.zeros((2, 2, 2, 3), np.uint8), "gamut": np.zeros((2, 2, 2), np.uint8)}, npz),
        lambda npz: hostile({"lut": np.zeros((33, 33, 33, 3)), "gamut": np.zeros((33, 33, 33))}, npz),
        lambda npz: hostile({"lut": np.zeros((33, 33, 33, 3), np.uint8)}, npz),
        lambda npz: hostile({"lut": np.array([{"a": 1}], object), "gamut": np.zeros(1)}, npz),
        lambda npz: np.savez_compressed(npz, lut=np.zeros(10**7, np.uint8), gamut=np.zeros(1)),
        lambda npz: npz.with_suffix(".json").write_text("{"),
        lambda npz: npz.with_suffix(".json").write_text('{"name": "x", "method": "magic"}'),
        lambda npz: npz.with_suffix(".json").unlink(),
    ],
    ids="cut empty text small float half pickle bomb json method headless".split(),
)
def test_broken_files_are_refused_in_one_sentence(tmp_path, break_it):
    for suffix in (".npz", ".json"):
        shutil.copy(packaged_path("calibration", "printers", f"coated{suffix}"), tmp_path / f"coated{suffix}")
    assert isinstance(load_printer("coated.npz", tmp_path), Printer)
    break_it(tmp_path / "coated.npz")
    with pytest.raises(Refused) as error:
        load_printer("coated.npz", tmp_path)
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------------------ from print to print


def test_no_change_leaves_colors_and_paper_stays_white():
    light = torch.rand(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(vary_print(light, torch.zeros(6)), light)
    draws = torch.rand(4, 6, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(vary_print(torch.ones(4, 3), draws), torch.ones(4, 3))


def test_density_is_a_power_of_the_light_down_to_a_thousandth():
    light, density = torch.tensor([[1e-3, 0.02, 0.5]], dtype=torch.float64), 0.2
    change = torch.tensor([0, density, 0, 0, 0, 0], dtype=torch.float64)
    torch.testing.assert_close(vary_print(light, change), light ** (1 + density))


def test_ink_variation_has_the_size_of_print_to_print_differences():
    seen = colors_of(load_printer("coated").apply(image(random_8bit())))
    draws = torch.rand(64, 1, 2, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 2 - 1
    draws *= torch.tensor([PrinterSettings().dot_gain[1], PrinterSettings().density[1]])
    draws = torch.nn.functional.pad(draws, (0, 4))
    varied = lab_from_linear(vary_print(torch.tensor(linear_from_srgb(seen)), draws).numpy())
    error = ciede2000(varied, lab_from_srgb(seen)[None])
    assert 0.5 < error.mean() < 2 and error.max() < 6


def test_variation_by_hand():
    change = torch.diag(torch.tensor([0.04, 0.05, 0.3, 0.1, 0.0, 0.0]))[:4]
    gained, dense, gray, veiled = vary_print(torch.full((4, 3), 0.5), change)
    assert gained.tolist() == pytest.approx([0.46] * 3)  # coverage 50 % grows by the dot gain of 4 points
    assert dense.tolist() == pytest.approx([0.5**1.05] * 3) and gray.tolist() == pytest.approx([0.5] * 3)
    assert veiled.tolist() == pytest.approx([0.55, 0.5, 0.5])
    red = vary_print(torch.tensor([0.5, 0.1, 0.1]), torch.tensor([0, 0, -0.5, 0, 0, 0])).tolist()
    luminance = 0.1 + 0.4 * LUMINANCE[0]
    assert red == pytest.approx([(0.5 + luminance) / 2, (0.1 + luminance) / 2, (0.1 + luminance) / 2])


def test_each_row_has_its_own_draw():
    light, draws = torch.rand(6, 3), torch.rand(6, 6)
    rows = torch.stack([vary_print(light[i], draws[i]) for i in range(6)])
    torch.testing.assert_close(vary_print(light, draws), rows)


def test_variation_has_finite_true_gradients():
    light = torch.tensor([[0.05, 0.4, 0.9]], dtype=torch.float64, requires_grad=True)
    draw = torch.tensor([[0.1, 0.9, 0.2, 0.1, 0.2, 0.7]], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: vary_print(x, draw), (light,))
    ends = torch.tensor([0.0, 1.0])[:, None].expand(2, 3).clone().requires_grad_(True)
    vary_print(ends, torch.tensor([-0.04, -0.05, 0.1, 0.004, 0.004, 0.004])).sum().backward()
    assert torch.isfinite(ends.grad).all()
