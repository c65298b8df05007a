"""A printer from an ICC output profile.

In: an RGB or CMYK profile of class `prtr`. Out: a `Printer` whose table follows the chain sRGB → printer → sRGB.
Towards the printer it uses the intent that the driver is set to, relative colorimetric or perceptual; back from it
always relative colorimetric: bare paper is 1, and an eye's or camera's adaptation to it is not applied twice.
LittleCMS (through Pillow) works in 8 bits here; without NOOPTIMIZE it replaces the chain by a coarse one (ΔE00 up to 5
on coated, 14 on uncoated paper). A bake measures its table against the exact chain and keeps the figures.
Left out on purpose: black point compensation, in which drivers differ.
"""

import hashlib
import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from patchproof.base.color import ciede2000, codes_from_srgb, lab_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.input import read_file
from patchproof.channel.printer import NODES_8BIT, Printer, node_colors, printer_from_table, printer_output

MAX_PROFILE_BYTES = 32 * 2**20  # the largest printer profiles in use are a few MB
_CHECKED_COLORS = 10_000
_INTENTS = {
    False: "relative colorimetric both ways, no black point compensation",
    True: "perceptual to the printer, relative colorimetric back, no black point compensation",
}


def bake(profile_path: Path, name: str, perceptual: bool = False) -> Printer:
    """The printer of a profile; `perceptual` is the intent towards paper."""
    data = _profile_bytes(profile_path)
    show, profile = _chain(data, profile_path.name, perceptual)
    nodes = codes_from_srgb(node_colors())
    lut = show(nodes)
    white = lut[-1, -1, -1]
    if white.min() < 250:  # relative to its medium, paper is white by definition, up to the profile's rounding
        got = f"sRGB white printed as {white.tolist()}"
        raise Refused("a profile that leaves white paper bare", got, "use another one")
    gamut = ciede2000(lab_from_srgb(nodes / 255), lab_from_srgb(lut / 255))
    printer = printer_from_table(name, "icc", lut / 255, gamut, {})
    printer.provenance.update(
        {
            "source": profile_path.name,
            "profile": (profile.profile_description or "").strip(),
            "profile_sha256": hashlib.sha256(data).hexdigest(),
            "profile_colors": profile.xcolor_space.strip(),
            "intents": _INTENTS[perceptual],
            "relative_to": f"paper: sRGB white is seen as {white.tolist()} of 255",
            "table": f"{len(NODES_8BIT)} nodes per channel at 0, 8, ..., 248, 255; trilinear",
            "delta_e00_to_exact_chain": _table_error(printer, show),
            "uncertainty": "one print to the next and one paper to the next differ by more, see the printer model",
        }
    )
    return printer


def _profile_bytes(path: Path) -> bytes:
    """Read the file; refused where it is missing, too large, or shorter than its own header says."""
    data = read_file(path, "an ICC profile", max_bytes=MAX_PROFILE_BYTES)
    if len(data) < 128 or data[36:40] != b"acsp":  # ICC.1, 7.2: the header and its signature
        raise Refused("an ICC profile", f"{path.name}, which does not begin with a profile's header", "check the file")
    if int.from_bytes(data[:4], "big") > len(data):
        got = f"{len(data)} of {int.from_bytes(data[:4], 'big')} bytes of {path.name}"
        raise Refused("a whole ICC profile", got, "copy the file again")
    return data


def _chain(data: bytes, file_name: str, perceptual: bool) -> tuple[Callable[[np.ndarray], np.ndarray], Any]:
    """(function uint8 ...×3 sRGB sent → uint8 sRGB seen, the profile's description) by LittleCMS."""
    from PIL import Image, ImageCms

    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(data))
        tags: Any = profile.profile
        kind, colors = tags.device_class.strip(), tags.xcolor_space.strip()
        _ = tags.profile_description  # reading tags shows damage
    except (OSError, ImageCms.PyCMSError, ValueError, TypeError, AttributeError) as error:
        got = f"{file_name} ({' '.join(str(error).split())[:100]})"
        raise Refused("an ICC profile that can be read", got, "use another one") from error
    if kind != "prtr" or colors not in {"RGB", "CMYK"}:
        got = f"class {kind} with {colors} in {file_name}"
        raise Refused("a printer's profile (class prtr, RGB or CMYK)", got, "use the profile of your printer and paper")
    relative, flags = ImageCms.Intent.RELATIVE_COLORIMETRIC, ImageCms.Flags
    to_printer = ImageCms.Intent.PERCEPTUAL if perceptual else relative
    srgb = ImageCms.createProfile("sRGB")
    exact_flags = flags.SOFTPROOFING | flags.NOOPTIMIZE | flags.NOCACHE
    try:
        chain = ImageCms.buildProofTransform(srgb, srgb, profile, "RGB", "RGB", to_printer, relative, flags=exact_flags)
    except (ImageCms.PyCMSError, ValueError, TypeError) as error:
        got = f"{file_name} without these tables ({' '.join(str(error).split())[:100]})"
        raise Refused("a profile with tables to and from the printer", got, "use another one") from error

    def show(srgb_8bit: np.ndarray) -> np.ndarray:
        image = Image.fromarray(np.ascontiguousarray(srgb_8bit.reshape(1, -1, 3)))
        return np.asarray(ImageCms.applyTransform(image, chain)).reshape(srgb_8bit.shape)

    return show, tags


def _table_error(printer: Printer, show: Callable[[np.ndarray], np.ndarray]) -> dict[str, float]:
    """ΔE00 between the interpolated table and the chain itself on random colors."""
    sent = np.random.default_rng(0).integers(0, 256, (_CHECKED_COLORS, 3), dtype=np.uint8)
    error = ciede2000(lab_from_srgb(show(sent) / 255), lab_from_srgb(printer_output(printer, sent / 255)))
    figures = {"mean": error.mean(), "p95": np.percentile(error, 95), "max": error.max()}
    return {"colors": _CHECKED_COLORS, **{key: round(float(value), 3) for key, value in figures.items()}}
