"""Twelve procedural objects for demos, tests and the built-in network's training; none of them is measured.

In: a name and a seed (proportions, part sizes, colors). Out: a Mesh in the object's natural size, y up, made of closed
parts that may run into one another, each with its own color and with texture coordinates (see solids.py), so that any
texture can be put on. An object with a flat side broad enough for a card shows it to +x; fronts look to +z.
"""

from functools import lru_cache

import numpy as np

from patchproof.base.errors import Refused
from patchproof.base.validation import spelling_hint
from patchproof.mesh.mesh import Mesh, MeshPart, mesh_from_parts
from patchproof.mesh.solids import box, lathe, prism, rotate_part, translate_part, tube


def primitive_names() -> tuple[str, ...]:
    """Return the objects' names, which `primitive:NAME` takes."""
    return tuple(_OBJECTS)


def build(name: str, seed: int = 0) -> Mesh:
    """Make one object; the same name and seed give the same arrays."""
    solids = parts(name, seed)
    return mesh_from_parts(solids, float(np.ptp(np.concatenate([part.vertices for part in solids]), axis=0).max()))


def longest_mm(name: str) -> float:
    """Return the longest extent of one object with seed 0, in whole millimeters."""
    return float(round(np.ptp(build(name).vertices, axis=0).max()))


@lru_cache(maxsize=16)
def parts(name: str, seed: int = 0) -> tuple[MeshPart, ...]:
    """Return one object's closed parts in millimeters, on y = 0; every face has three vertices of its own."""
    if name not in _OBJECTS:
        raise Refused("the name of a primitive", f'"{name}"', spelling_hint(name, _OBJECTS))
    return tuple(_OBJECTS[name](np.random.default_rng([primitive_names().index(name), seed])))


WHITE, BLACK, STEEL, WOOD = (0.92, 0.92, 0.9), (0.1, 0.1, 0.11), (0.66, 0.67, 0.7), (0.65, 0.46, 0.28)
RED, BLUE, GREEN, YELLOW = (0.75, 0.16, 0.13), (0.15, 0.3, 0.62), (0.16, 0.45, 0.25), (0.9, 0.72, 0.15)
PAINTS = (RED, BLUE, GREEN, YELLOW, (0.9, 0.9, 0.88), (0.3, 0.31, 0.34))


def _paint(rng, choices=PAINTS) -> np.ndarray:
    return np.clip(np.asarray(choices[rng.integers(len(choices))]) + rng.normal(0, 0.05, 3), 0.02, 0.98)


def _arc(center, radius, start_deg: float, end_deg: float, n: int) -> np.ndarray:
    """Return n points (a, b) on an ellipse of radii (a, b)."""
    angle = np.radians(np.linspace(start_deg, end_deg, n))
    return np.stack([center[0] + radius[0] * np.cos(angle), center[1] + radius[1] * np.sin(angle)], 1)


def _mug(rng) -> list[MeshPart]:
    h, r, wall, foot = rng.uniform(80, 110), rng.uniform(36, 46), rng.uniform(3, 5), rng.uniform(0.8, 1.0)
    color = _paint(rng)
    outer = [(0, 0), (r * foot * 0.92, 0), (r * foot, h * 0.04), (r * (0.5 + foot / 2), h * 0.4), (r, h * 0.8), (r, h)]
    body = lathe([*outer, (r - wall, h), (r * foot - wall, h * 0.08), (0, h * 0.07)], "body", color)
    bow = _arc((r - wall / 2, h * 0.52), (rng.uniform(22, 32), h * rng.uniform(0.26, 0.34)), -90, 90, 13)
    thick, paint = rng.uniform(4.5, 6.5), color if rng.random() < 0.7 else _paint(rng)
    return [body, tube([(0, y, z) for z, y in bow], thick, "handle", paint)]


def _bottle(rng) -> list[MeshPart]:
    h, r = rng.uniform(230, 310), rng.uniform(32, 42)
    neck, shoulder, cap = r * rng.uniform(0.3, 0.42), h * rng.uniform(0.52, 0.66), h * rng.uniform(0.05, 0.09)
    glasses = ((0.12, 0.3, 0.16), (0.34, 0.18, 0.08), (0.6, 0.75, 0.75), (0.15, 0.25, 0.5), (0.75, 0.2, 0.15))
    glass, bends = _paint(rng, glasses), np.linspace(0.4, np.pi, 6)
    slope = [(neck + (r - neck) * (0.5 + 0.5 * np.cos(t)), shoulder + h * 0.16 * t / np.pi) for t in bends]
    side = [(0, 0), (r * 0.93, 0), (r, h * 0.025), (r, shoulder), *slope, (neck, h - cap), (0, h - cap)]
    body = lathe(side, "body", glass)
    low, high = h * rng.uniform(0.1, 0.18), h * rng.uniform(0.38, 0.46)
    band = lathe([(0, low), (r + 0.4, low), (r + 0.4, high), (0, high)], "label", _paint(rng))
    return [body, band, lathe([(0, h - cap), (neck + 1.5, h - cap), (neck + 1.5, h), (0, h)], "cap", _paint(rng))]


def _traffic_cone(rng) -> list[MeshPart]:
    h, base = rng.uniform(450, 750), rng.uniform(0.52, 0.62)
    foot, top = rng.uniform(0.19, 0.23), rng.uniform(0.03, 0.05)
    orange = _paint(rng, ((0.95, 0.4, 0.08), (0.9, 0.25, 0.1), (0.93, 0.55, 0.1)))
    thick = h * 0.04

    def radius(share: float, more: float = 0.0) -> float:
        return h * (foot + (top - foot) * share) + more

    cone = lathe([(0, thick / 2), (radius(0), thick / 2), (radius(1), h), (0, h)], "cone", orange)
    solids = [box((h * base, thick, h * base), (0, 0, 0), "base", orange if rng.random() < 0.5 else BLACK), cone]
    for low in (0.35, 0.68)[: rng.integers(1, 3)]:
        high, grow = low + rng.uniform(0.12, 0.22), h * 0.004
        y0, y1 = thick / 2 + low * (h - thick / 2), thick / 2 + high * (h - thick / 2)
        solids.append(lathe([(0, y0), (radius(low, grow), y0), (radius(high, grow), y1), (0, y1)], "stripe", WHITE))
    return solids


def _street_sign(rng) -> list[MeshPart]:
    h, size = rng.uniform(1500, 2000), rng.uniform(760, 900)
    # corners, first corner's angle, reach of a corner in halves of the size
    shapes = ((3, 90, 1.25), (3, -90, 1.25), (4, 45, 1.41), (4, 0, 1.2), (8, 22.5, 1.08), (32, 0, 1.0))
    sides, turn, reach = shapes[rng.choice(6, p=(0.1, 0.1, 0.2, 0.15, 0.25, 0.2))]
    face = _paint(rng, (*PAINTS[:4], WHITE))

    def plate(scale: float, x0: float, x1: float, name: str, srgb) -> MeshPart:
        angle = np.radians(turn) + np.arange(sides) * 2 * np.pi / sides
        outline = np.stack([-np.cos(angle), np.sin(angle)], 1) * size / 2 * reach * scale
        return translate_part(prism(outline, x0, x1, name, srgb), (0, h - size / 2, 0))

    path = [(-22, 0, 0), (-22, h * 0.5, 0), (-22, h - size * 0.3, 0)]
    post = tube(path, rng.uniform(24, 34), "post", _paint(rng, (STEEL, WOOD)))
    solids = [post, plate(1, 0, 14, "rim", WHITE if rng.random() < 0.7 else BLACK), plate(0.9, 1, 16, "face", face)]
    if rng.random() < 0.6:  # a bar or a disc instead of lettering
        mark = WHITE if face.mean() < 0.6 else BLACK
        bar = (size * rng.uniform(0.1, 0.2), size * rng.uniform(0.4, 0.6))[:: 1 if rng.random() < 0.5 else -1]
        solids.append(box((2, *bar), (17, h - size / 2 - bar[0] / 2, 0), "mark", mark))
    return solids


def _box_truck(rng) -> list[MeshPart]:
    w, tall = rng.uniform(2000, 2400), rng.uniform(2100, 2600)
    cab, cargo = rng.uniform(1500, 1900), rng.uniform(3600, 5000)
    wheel, floor = rng.uniform(400, 480), rng.uniform(560, 680)
    front, paint, glass = cargo / 2 + cab, _paint(rng), (0.12, 0.16, 0.2)
    roof = floor + tall * rng.uniform(0.62, 0.78)
    nose, sill, back = front - rng.uniform(150, 500), floor + (roof - floor) * 0.5, cargo / 2 + 90
    low = floor - 120
    side = [(back, low), (back, roof), (nose, roof), (front - 60, sill), (front, floor + 50), (front, low)]
    slope, offset = np.array([(nose, roof - 60), (front - 60, sill + 40)]), np.array([25, 0])
    solids = [
        box((w, tall, cargo), (0, floor, 0), "cargo", _paint(rng, (WHITE, WHITE, *PAINTS))),
        prism(side, -w * 0.46, w * 0.46, "cab", paint),
        prism(np.concatenate([slope + offset, slope[::-1] - 2 * offset]), -w * 0.4, w * 0.4, "windshield", glass),
        box((w * 0.5, 180, cargo + cab * 0.9), (0, floor - 200, cab * 0.45), "frame", BLACK),
        box((w * 0.96, 200, 120), (0, floor - 260, front), "bumper", _paint(rng, (STEEL, BLACK))),
    ]
    for x in (-w * 0.46, w * 0.46):
        solids.append(box((20, (roof - sill) * 0.75, cab * 0.36), (x, sill + 60, back + cab * 0.4), "window", glass))
        solids.append(box((w * 0.12, 130, 40), (x * 0.78, floor + 20, front), "lamp", (0.95, 0.93, 0.8)))
        for z in (-cargo * 0.3, front - cab * 0.55):
            profile = [(0, 0), (wheel * 0.96, 0), (wheel, 40), (wheel, 220), (wheel * 0.96, 260), (0, 260)]
            tire = rotate_part(lathe(profile, "tire", BLACK), 2, -90)
            hub = rotate_part(lathe([(0, -12), (wheel * 0.5, -12), (wheel * 0.5, 272), (0, 272)], "hub", STEEL), 2, -90)
            solids += [translate_part(part, (x * 0.96 - 130, wheel, z)) for part in (tire, hub)]
    return solids


def _chair(rng) -> list[MeshPart]:
    w, d, seat, back = rng.uniform(400, 480), rng.uniform(390, 460), rng.uniform(420, 470), rng.uniform(380, 500)
    leg, color = rng.uniform(28, 45), _paint(rng, (WOOD, WOOD, *PAINTS))
    frame = color if rng.random() < 0.6 else _paint(rng, (STEEL, BLACK, WOOD))
    solids = [box((d, 40, w), (0, seat - 40, 0), "seat", color)]
    for z in (-w / 2 + leg / 2, w / 2 - leg / 2):
        solids.append(box((leg, seat - 20, leg), (d / 2 - leg / 2, 0, z), "leg", frame))
        solids.append(box((leg, seat + back, leg), (-d / 2 + leg / 2, 0, z), "leg", frame))
    slats = int(rng.integers(1, 5))
    pitch = back * 0.8 / slats
    slat = (leg * 0.6, pitch * (0.62 if slats > 1 else 1), w - leg)
    for i in range(slats):
        solids.append(box(slat, (-d / 2 + leg / 2, seat + back * 0.17 + i * pitch, 0), "back", color))
    if rng.random() < 0.5:
        rail = (d - leg, leg * 0.6, leg * 0.6)
        solids += [box(rail, (0, seat * 0.4, z), "rail", frame) for z in (leg / 2 - w / 2, w / 2 - leg / 2)]
    return solids


def _table_lamp(rng) -> list[MeshPart]:
    h, shade, foot = rng.uniform(420, 560), rng.uniform(125, 165), rng.uniform(70, 95)
    top, low, belly = shade * rng.uniform(0.5, 0.85), h * rng.uniform(0.54, 0.62), rng.uniform(10, 55)
    metal = _paint(rng, (*PAINTS, STEEL, WOOD))
    cover = _paint(rng, ((0.93, 0.88, 0.75), (0.95, 0.93, 0.9), (0.8, 0.3, 0.25), (0.35, 0.5, 0.6)))
    stem = [(10 + belly * np.sin(np.pi * t) ** 2, h * (0.06 + 0.45 * t)) for t in np.linspace(0, 1, 9)]
    side = [(0, 0), (foot, 0), (foot, h * 0.025), (foot * 0.4, h * 0.05), *stem, (9, h * 0.9), (0, h * 0.9)]
    profile = [(0, h - 6), (top - 4, h - 6), (shade - 4, low), (shade, low), (top, h), (0, h)]
    return [lathe(side, "base", metal), lathe(profile, "shade", cover)]


def _carton(rng) -> list[MeshPart]:
    x, z, y = rng.uniform(180, 320), rng.uniform(320, 460), rng.uniform(220, 380)
    card = _paint(rng, ((0.72, 0.55, 0.37), (0.66, 0.49, 0.32), (0.8, 0.68, 0.5)))
    solids = [box((x, y, z), (0, 0, 0), "body", card)]
    wide = rng.uniform(40, 60)
    if rng.random() < 0.5:  # closed and taped
        tape = _paint(rng, ((0.82, 0.72, 0.52), (0.6, 0.42, 0.22), (0.9, 0.88, 0.8)))
        solids.append(box((wide, 0.8, z + 1.2), (0, y - 0.2, 0), "tape", tape))
        solids += [box((wide, 70, 0.8), (0, y - 70, s * (z / 2 + 0.2)), "tape", tape) for s in (-1, 1)]
    else:  # flaps folded out
        solids.append(box((x - 8, 1, z - 8), (0, y - 0.5, 0), "inside", card * 0.35))
        for s in (-1, 1):
            flap = box((x / 2, 4, z), (s * x / 4, 0, 0), "flap", card)
            solids.append(translate_part(rotate_part(flap, 2, s * rng.uniform(-50, 45)), (s * x / 2, y, 0)))
            short = box((x, 4, x / 2), (0, 0, s * x / 4), "flap", card)
            solids.append(translate_part(rotate_part(short, 0, s * rng.uniform(-45, 50)), (0, y, s * z / 2)))
    if rng.random() < 0.5:  # an address label on the small side
        solids.append(box((x * 0.5, y * 0.3, 0.8), (0, y * rng.uniform(0.15, 0.5), z / 2), "label", WHITE))
    return solids


def _mailbox(rng) -> list[MeshPart]:
    x, z, y = rng.uniform(420, 520), rng.uniform(460, 580), rng.uniform(620, 780)
    leg, bow, paint = rng.uniform(100, 220), rng.uniform(0.3, 0.5), _paint(rng, PAINTS[:4])
    arch = _arc((0, leg + y), (z / 2, z * bow), 0, 180, 13)
    solids = [prism([(-z / 2, leg), (z / 2, leg), *arch], -x / 2, x / 2, "body", paint)]
    for a, b in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        solids.append(box((50, leg + 5, 50), (a * (x / 2 - 30), 0, b * (z / 2 - 30)), "leg", paint * 0.8))
    handle = box((x * 0.7, 30, 50), (0, leg + y * 0.98, z / 2 + 5), "handle", _paint(rng, (STEEL, BLACK)))
    slot = box((x * 0.8, y * rng.uniform(0.14, 0.22), 12), (0, leg + y * 0.74, z / 2), "slot", BLACK)
    card = box((x * rng.uniform(0.4, 0.7), y * rng.uniform(0.15, 0.3), 8), (0, leg + y * 0.35, z / 2), "card", WHITE)
    return [*solids, handle, slot, card]


def _umbrella(rng) -> list[MeshPart]:
    reach, h = rng.uniform(450, 560), rng.uniform(820, 940)
    dome, ribs, color = reach * rng.uniform(0.4, 0.62), 8, _paint(rng)
    outer = [(reach * np.sin(t), h - dome + dome * np.cos(t)) for t in np.linspace(np.pi / 2, 0, 9)[:-1]]
    inner = [(r * 0.985 - 2, y - 6) for r, y in outer[::-1]]
    canopy = lathe([(0, h - 8), *inner, *outer, (0, h)], "canopy", color, around=ribs)
    steel = tube([(0, 60, 0), (0, h * 0.5, 0), (0, h + 40, 0)], 8, "shaft", _paint(rng, (STEEL, BLACK, WOOD)))
    hook = [(0, 160, 0), (0, 100, 0), *((0, y, z) for z, y in _arc((42, 60), (42, 50), 180, 340, 10))]
    return [canopy, steel, tube(hook, 14, "handle", _paint(rng, (WOOD, BLACK, *PAINTS)))]


def _watering_can(rng) -> list[MeshPart]:
    h, r, taper = rng.uniform(190, 260), rng.uniform(85, 115), rng.uniform(0.75, 1.0)
    color = _paint(rng, (*PAINTS, STEEL))
    wall = 4
    inside = [(r * taper - wall, h), (r * taper - wall, h * 0.8), (0, h * 0.8)]
    body = lathe([(0, 0), (r, 0), (r, 8), (r * taper, h), *inside], "body", color)
    reach, rise = rng.uniform(190, 250), rng.uniform(1.0, 1.25)
    path = [(h * 0.2, r * 0.8), (h * 0.32, r + reach * 0.3), (h * 0.68, r + reach * 0.65), (h * rise, r + reach)]
    spout = tube([(0, y, z) for y, z in path], [26, 20, 15, 12], "spout", color)
    side = [(0, 0), (13, 0), (rng.uniform(30, 42), 40), (0, 46)]
    rose = lathe(side, "rose", color if rng.random() < 0.5 else _paint(rng))
    rose = translate_part(rotate_part(rose, 0, rng.uniform(35, 60)), (0, h * rise - 8, r + reach - 8))
    bow = _arc((-r * taper * 0.75, h * 0.72), (rng.uniform(75, 105), h * rng.uniform(0.4, 0.55)), 60, 260, 15)
    return [body, spout, rose, tube([(0, y, z) for z, y in bow], rng.uniform(8, 12), "handle", color)]


def _hammer(rng) -> list[MeshPart]:
    h, r = rng.uniform(290, 360), rng.uniform(13, 17)
    grip, steel = _paint(rng, (WOOD, WOOD, *PAINTS)), _paint(rng, (STEEL, STEEL, BLACK))
    shaft = [(r * 0.95, 0), (r * 1.15, 12), (r, h * 0.3), (r * 0.72, h * 0.55), (r * 0.7, h)]
    handle = lathe([(0, 0), *shaft, (0, h)], "handle", grip)
    head, face, reach = h - r * 1.1, rng.uniform(15, 19), rng.uniform(48, 62)
    profile = [(0, -22), (r, -22), (r * 1.15, 0), (face * 0.75, 18), (face * 0.75, reach - 20)]
    profile += [(face, reach - 14), (face, reach), (0, reach)]
    solids = [handle, translate_part(rotate_part(lathe(profile, "head", steel), 0, 90), (0, head, 0))]
    drop, back = rng.uniform(20, 45), reach * rng.uniform(1.1, 1.4)
    for side in (-1, 1):
        bow = [(side * (4 + 9 * t), head + 4 - drop * t * t, -10 - back * t) for t in np.linspace(0, 1, 7)]
        solids.append(tube(bow, np.linspace(11, 3.5, 7), "claw", steel))
    return solids


_MAKERS = (_mug, _bottle, _traffic_cone, _street_sign, _box_truck, _chair, _table_lamp, _carton, _mailbox)
_MAKERS += (_umbrella, _watering_can, _hammer)
_OBJECTS = {make.__name__[1:]: make for make in _MAKERS}
