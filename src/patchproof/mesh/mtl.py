"""Read MTL files, the materials of OBJ files.

In: the lines `mtllib` of an OBJ file. Out: materials on demand, with the scale and shift of their texture coordinates
(v up). Kd is taken as sRGB, as exporters write it, and multiplies map_Kd. Options of map_Kd: -s, -o, -clamp and -mm are
used, others are said. Left out on purpose: other maps, emission, transparency.
"""

from collections.abc import Sequence
from itertools import takewhile
from pathlib import Path

import numpy as np

from patchproof.base.color import linear_from_srgb
from patchproof.base.validation import summarize_names
from patchproof.mesh.assets import VERTEX_COLORS, WHITE, Assets
from patchproof.mesh.mesh import Material
from patchproof.mesh.texture_wrap import Wrap

_MAPS = ("map_", "bump", "norm", "disp", "decal", "refl")
_MOST_NUMBERS = {"-mm": 2, "-s": 3, "-o": 3, "-t": 3}  # after an option; others have one word
_WITHOUT_EFFECT = ("-blendu on", "-blendv on", "-cc off", "-boost 0", "-t 0", "-t 0 0", "-t 0 0 0")


def logical_lines(data: bytes) -> list[str]:
    """Return the lines of a text; a backslash at a line's end continues it."""
    text = data.decode("utf-8-sig", errors="replace").replace("\r\n", "\n").replace("\r", "\n")
    return text.replace("\\\n", " ").split("\n")


class MaterialLibrary:
    """The materials that an OBJ file's MTL files define, and how textures continue that do not repeat."""

    def __init__(self, assets: Assets):
        self.assets, self.wraps = assets, dict[Material, tuple[Wrap, Wrap]]()
        self._entries: dict[str, tuple[Path | None, dict[str, str]]] = {}
        self._made: dict[tuple[str, bool], tuple[Material, np.ndarray, np.ndarray]] = {}

    def read(self, names: str) -> None:
        """Read the files of a line: one name, which may hold spaces, or several."""
        for name in [names] if self.assets.find(names) else names.split():
            path, values = self.assets.find(name), {}
            if path is None:
                self.assets.say(f"the material file {name} is missing in the folder of {self.assets.path.name}")
            for line in logical_lines(self.assets.read(name)) if path else ():
                key, value = [*line.split(None, 1), "", ""][:2]
                if key == "newmtl":
                    values = self._entries.setdefault(value.strip(), (path and path.parent, {}))[1]
                else:
                    values[key.lower()] = value.strip()

    def check_names(self, names: Sequence[str]) -> None:
        """Warn of materials that are used and that no file defines."""
        if undefined := [name for name in dict.fromkeys(names) if name and name not in self._entries]:
            self.assets.say(f"no MTL file defines {summarize_names(undefined)}")

    def material(self, name: str, has_uv: bool, has_colors: bool) -> tuple[Material, np.ndarray, np.ndarray]:
        """Return a material, made once, and the scale and shift of its texture coordinates."""
        if (name, has_uv) not in self._made:
            folder, values = self._entries.get(name, (None, {}))
            texture, (options, file_name) = None, _options(values.get("map_kd", ""))
            if file_name and has_uv:
                base, gain = _numbers(options.get("-mm", "0 1"))
                texture = self.assets.texture(self.assets.read(file_name, folder, True), file_name, base, gain)
            elif file_name:
                self.assets.say("a texture without texture coordinates is left out")
            self._say_left_out(values, options)
            material = VERTEX_COLORS
            if texture is not None or not has_colors:
                material = Material(name or "unnamed", self._kd(name, values, texture is not None), texture)
            self.wraps |= {material: ("clamp", "clamp")} if options.get("-clamp") == "on" else {}
            scale, shift = _numbers(options.get("-s", "")), _numbers(options.get("-o", ""))
            self._made[name, has_uv] = material, np.array([*scale, 1, 1])[:2], np.array([*shift, 0, 0])[:2]
        return self._made[name, has_uv]

    def _kd(self, name: str, values: dict[str, str], has_texture: bool) -> tuple[float, float, float]:
        """Return Kd as linear light; one number counts for all three, and black beside a texture as white."""
        kd = _numbers(text := values.get("kd", ""))
        if len(kd) < len(text.split()):  # "spectral" and "xyz" are allowed, too
            self.assets.say(f"Kd {text[:40]} of {name} is not read")
        if len(kd) not in (1, 3) or len(kd) < len(text.split()) or (has_texture and not any(kd)):
            return WHITE if has_texture else self.assets.gray().base_color_linear
        red, green, blue = np.broadcast_to(linear_from_srgb(np.clip(kd, 0, 1)), 3).tolist()
        return red, green, blue

    def _say_left_out(self, values: dict[str, str], options: dict[str, str]) -> None:
        others = [key for key, value in options.items() if f"{key} {value}" not in _WITHOUT_EFFECT]
        left_out = [f"map_Kd {key}" for key in others if key not in ("-s", "-o", "-mm", "-clamp")]
        left_out += [key for key in values if key.startswith(_MAPS) and key not in ("map_kd", "map_d")]
        left_out += ["Ke"] if any(_numbers(values.get("ke", ""))) else []
        if left_out:
            self.assets.say(f"left out of materials: {', '.join(left_out)}")
        opacity = [*_numbers(values.get("d", "")), *(1 - tr for tr in _numbers(values.get("tr", "")))]
        if "map_d" in values or min(opacity[:1], default=1) < 1:  # some exporters write d 1 and Tr 1 for opaque
            self.assets.say("transparent materials are drawn opaque")


def _numbers(text: str) -> list[float]:
    """Return the numbers in a value, without words such as -halo, spectral or xyz."""
    return [float(word) for word in text.split() if _is_number(word)]


def _options(text: str) -> tuple[dict[str, str], str]:
    """Return the options of a map and the name of its file, which may hold spaces."""
    words, options = text.split(), {}
    while len(words) > 1 and words[0].startswith("-"):
        key, most = words[0], _MOST_NUMBERS.get(words[0], 1)
        count = len([*takewhile(_is_number, words[1 : 1 + most])]) if most > 1 else 1
        options[key], words = " ".join(words[1 : 1 + count]), words[1 + count :]
    return options, " ".join(words)


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False
