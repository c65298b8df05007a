"""Photograph a scene by an independent renderer: Mitsuba 3 traces paths under the same conditions.

In: a stage, the printed piece (or none) and one view's conditions. Out: a picture, as `render.photograph` makes it.
Mitsuba adds the effects that our renderer leaves out: cast shadows with soft edges, light that is reflected between
paper and object, and depth of field. Conditions do not have the size of light and lens: `draw_optics` draws them. Our
own are the printer, the camera behind its lens (`channel.camera`), and the picture in the background, which lights
nothing. Levels follow `channel.camera`: a surface with nothing around it gets the same light. Left out on purpose:
colored light, transparency, scenes made of pictures.

Sources: Jakob et al., Mitsuba 3 renderer, 2022; Veach and Guibas, Optimally Combining Sampling Techniques for Monte
Carlo Rendering, SIGGRAPH 1995, for why the surrounding light is sampled by the surface alone.
"""

from importlib import import_module
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from patchproof.base import geometry
from patchproof.base.color import LINEAR_FROM_CODE, linear_from_srgb
from patchproof.base.errors import Refused
from patchproof.base.geometry import Frame
from patchproof.channel.camera import develop
from patchproof.channel.effects import Light
from patchproof.channel.printer import MOTTLE_CELLS, mottle_cells, mottled, print_change, vary_print
from patchproof.mesh.mesh import Mesh
from patchproof.render.photograph import PAPER_BACK_LINEAR
from patchproof.render.pixels import PiecePicture
from patchproof.render.stage import Stage
from patchproof.render.views import backgrounds, lens_frame
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import require_piece
from patchproof.scene.mesh_scene import MeshScene, require_mesh
from patchproof.scene.patch_scene import require_patch

PAPER_REFLECTANCE = 0.85  # of white paper, whose light is 1
LIGHT_RADIUS_DEG = (0.5, 8.0)  # of the directional light as the piece sees it: from about the sun to a window
APERTURE_MM = (1.0, 6.0)  # from a phone's lens to a small camera's
PASSES, PASS_SAMPLES = 2, 16  # paths per pixel; a pass at a time bounds memory: 2 GB at 2 megapixels
MOST_BOUNCES = 4  # of a path, the light included: paper lit by what paper lights
_SQUARE = 1e-4  # how far a pixel's sides may differ
_FIRST_LLVM = 17  # older versions end the whole process: they cannot compile Dr.Jit's minimum
_FAR = 20.0  # the directional light's distance in lengths of the object
_SKY_PX = (64, 128)
_SKY_WEIGHT = 1e-3  # share of light samples; Mitsuba refuses 0 if there is no other light


def draw_optics(conditions: Conditions) -> tuple[float, float]:
    """Draw, by one view's noise seed, the directional light's radius in degrees and the lens's diameter in mm."""
    rng = np.random.default_rng([int(conditions.sensor.noise_seed[0]), 1])
    light_radius_deg, aperture_mm = rng.uniform(*np.transpose([LIGHT_RADIUS_DEG, APERTURE_MM])).tolist()
    return light_radius_deg, aperture_mm


def photograph_traced(stage: Stage, piece: PiecePicture | None, conditions: Conditions) -> Tensor:
    """Photograph one view, without JPEG: 1×3×H×W sRGB; `piece=None` is the bare object. Refused if the scene has no
    mesh, or a camera whose pixels are not square.
    """
    scene = require_mesh(stage.scene, "a scene with a mesh to trace paths in", "choose one with object.mesh")
    (light_radius_deg, aperture_mm), photo_px = draw_optics(conditions), scene.photo_px
    matrix = scene.matrix_px(photo_px)
    if abs(matrix[0, 0] / matrix[1, 1] - 1) > _SQUARE:
        raise Refused("a camera with square pixels", f"fx / fy = {matrix[0, 0] / matrix[1, 1]:.5f}", "set fy to fx")
    mi, frame = mitsuba(), lens_frame(stage, scene, photo_px)
    box = _box(scene, conditions, frame, aperture_mm)
    parts = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": MOST_BOUNCES, "hide_emitters": True},
        "sensor": _sensor(mi, scene, conditions, frame, box, aperture_mm),
        **_lights(mi, scene, conditions.light, light_radius_deg),
        **{f"object{i}": part for i, part in enumerate(_object(mi, scene.mesh))},
    }
    if piece is not None:
        parts["piece"] = _piece(mi, scene, piece, conditions)
    left, top, width, height = box
    mitsuba_scene, total = mi.load_dict(parts), np.zeros((height, width, 4))
    for i in range(PASSES):  # no two views share a seed
        seed = (int(conditions.sensor.noise_seed[0]) * PASSES + i) % 2**32
        total = total + np.array(mi.render(mitsuba_scene, spp=PASS_SAMPLES, seed=seed), np.float64) / PASSES
    light = LINEAR_FROM_CODE[backgrounds(scene, conditions, photo_px, frame)[0]]
    inside = light[top : top + height, left : left + width]
    inside *= 1 - total[..., 3:].clip(0, 1)
    inside += total[..., :3] / PAPER_REFLECTANCE
    traced = torch.tensor(light, dtype=torch.float32).permute(2, 0, 1)[None]
    traced = stage.scene.camera.distort_pictures(traced, photo_px) if stage.scene.camera else traced
    return develop(traced, conditions.sensor, 1.0, jpeg=False)


def mitsuba() -> ModuleType:
    """Load Mitsuba: with LLVM if a recent one is installed, else its slow variant. Refused if Mitsuba is missing."""
    try:
        drjit, mi = import_module("drjit"), import_module("mitsuba")
    except ImportError as error:
        raise Refused("Mitsuba 3 for path tracing", "none installed", "pip install 'patchproof[pathtrace]'") from error
    if mi.variant() is None:
        try:
            mi.set_variant("llvm_ad_rgb")
            if drjit.detail.llvm_version()[0] < _FIRST_LLVM:
                mi.set_variant("scalar_rgb")
        except ImportError:  # raised by Dr.Jit if it finds no LLVM
            mi.set_variant("scalar_rgb")
    if mi.variant().startswith("llvm"):
        drjit.set_thread_count(torch.get_num_threads())
    return mi


def _box(scene: MeshScene, conditions: Conditions, frame: Frame, aperture_mm: float) -> tuple[int, int, int, int]:
    """Bound what shows object and piece (left, top, width, height, 1 at least): it is traced in a third of the time."""
    points = [scene.mesh.vertices, require_piece(scene).paper()[0]] if scene.HAS_PIECE else [scene.mesh.vertices]
    px = geometry.project(frame.matrix_px, scene.camera_from_world(conditions)[0], np.concatenate(points))
    if not np.isfinite(px).all():  # some of it lies behind the camera
        return 0, 0, *frame.size_px
    # the margin covers blur out of focus and prints that are larger
    margin = 8 + 0.05 * np.ptp(px, axis=0) + frame.matrix_px[0, 0] * aperture_mm / conditions.pose.distance_mm[0]
    size = np.array(frame.size_px)
    low = np.clip(np.floor(px.min(0) - margin), 0, size - 1).astype(int)
    high = np.clip(np.ceil(px.max(0) + margin), low + 1, size).astype(int)
    return int(low[0]), int(low[1]), int(high[0] - low[0]), int(high[1] - low[1])


def _sensor(mi: ModuleType, scene: MeshScene, conditions: Conditions, frame: Frame, box, aperture_mm: float) -> dict:
    """A thin lens focused on the piece's middle; a pinhole if the principal point is not the picture's middle.

    Mitsuba's cameras have x left and y up.
    """
    pose = scene.camera_from_world(conditions)[0]
    (width, height), matrix = frame.size_px, frame.matrix_px
    middle = pose[:3, :3] @ scene.middle_mm + pose[:3, 3]
    off = matrix[:2, 2] / frame.size_px - 0.5
    lens = {"type": "thinlens", "aperture_radius": aperture_mm / 2, "focus_distance": float(middle[2])}
    if aperture_mm == 0 or off.any():
        lens = {"type": "perspective"} | {f"principal_point_offset_{x}": float(off[i]) for i, x in enumerate("xy")}
    film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba"}
    film |= dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), box, strict=True))
    film |= {"rfilter": {"type": "box"}}  # a pixel averages over its own square
    to_world = mi.ScalarTransform4f(np.linalg.inv(pose) @ np.diag([-1.0, -1.0, 1.0, 1.0]))
    lens |= {"to_world": to_world, "fov": float(np.degrees(2 * np.arctan(width / 2 / matrix[0, 0]))), "fov_axis": "x"}
    lens |= {"near_clip": 1.0, "far_clip": 1e6, "film": film}
    return lens | {"sampler": {"type": "multijitter", "sample_count": PASS_SAMPLES}}


def _lights(mi: ModuleType, scene: MeshScene, light: Light, radius_deg: float) -> dict:
    """The surroundings, and a disk far away for the directional light.

    An outgoing radiance of 1 is white: paper of reflectance ρ gives ρ·E/π, so that E is π where our light is 1.
    """
    # hardly any light samples go to the surroundings: scattered paths reach them anyway
    sky = mi.Bitmap(np.full((*_SKY_PX, 3), light.ambient[0], np.float32))
    emitters = {"sky": {"type": "envmap", "bitmap": sky, "sampling_weight": _SKY_WEIGHT}}
    if light.directional[0] > 0:
        frame, middle = scene.frame, scene.middle_mm
        toward = geometry.orbit(light.light_azimuth_deg, light.light_elevation_deg, frame.normal, frame.up)[0]
        far, angle = _FAR * scene.length_mm, np.radians(radius_deg)
        radiance = {"type": "rgb", "value": [float(light.directional[0] / np.sin(angle) ** 2)] * 3}
        place = np.linalg.inv(geometry.look_at(middle + far * toward, middle))
        to_world = mi.ScalarTransform4f(place @ np.diag([*[far * np.tan(angle)] * 3, 1]))
        emitters["sun"] = {"type": "disk", "to_world": to_world, "emitter": {"type": "area", "radiance": radiance}}
    return emitters


def _piece(mi: ModuleType, scene: MeshScene, picture: PiecePicture, conditions: Conditions):
    """The printed piece as large as it was printed, with plain paper on its back."""
    placement = require_patch(scene).placement
    scale = conditions.pose.printed_scale[0]
    vertices = scene.middle_mm + scale * (placement.vertices_mm - scene.middle_mm)
    change = torch.tensor(print_change(conditions.print)[0]).to(picture.srgb)
    printed = picture.srgb
    if rms := float(conditions.print.mottle[0]):
        cells = mottle_cells(int(conditions.print.mottle_seed[0])).reshape(MOTTLE_CELLS, MOTTLE_CELLS, 3)
        rows, columns = (np.arange(n) * MOTTLE_CELLS // max(picture.size_px) for n in printed.shape[:2])
        printed = mottled(printed, torch.tensor(rms * cells[rows][:, columns]).to(printed))
    light = vary_print(linear_from_srgb(printed), change).numpy()  # relative to white paper
    back = {"type": "rgb", "value": PAPER_BACK_LINEAR * PAPER_REFLECTANCE}
    uv = placement.piece_mm / np.array(placement.size_mm)
    colors = _texture(mi, light, "clamp"), back
    return _mesh(mi, "piece", vertices, placement.faces, placement.normals, uv, colors)


def _object(mi: ModuleType, mesh: Mesh) -> list:
    """One Mitsuba mesh per material; corners are not shared, since each has its normal and texture coordinates."""
    shapes = []
    for number, material in enumerate(mesh.materials):
        faces = np.flatnonzero(mesh.face_material == number)
        if not len(faces):
            continue
        colors = (mesh.corner_color_linear[faces] * np.array(material.base_color_linear)).reshape(-1, 3)
        color = {"type": "mesh_attribute", "name": "vertex_color"}
        if material.texture_srgb is not None:
            if np.ptp(colors, axis=0).max() > 1 / 255:
                raise Refused("materials with a texture or corner colors", f"both in {material.name}", "bake them")
            color = _texture(mi, LINEAR_FROM_CODE[material.texture_srgb] * colors[0], "repeat")
        corners = mesh.vertices[mesh.faces[faces]].reshape(-1, 3)
        normals, uv = mesh.corner_normal[faces].reshape(-1, 3), mesh.corner_uv[faces].reshape(-1, 2)
        paint = (colors * PAPER_REFLECTANCE).clip(0, 1)
        triangles = np.arange(3 * len(faces)).reshape(-1, 3)
        shapes.append(_mesh(mi, f"object{number}", corners, triangles, normals, uv, (color, color), paint))
    return shapes


def _texture(mi: ModuleType, linear: np.ndarray, wrap: str) -> dict:
    """Convert light relative to white paper to a texture of reflectances."""
    bitmap = mi.Bitmap((linear * PAPER_REFLECTANCE).clip(0, 1).astype(np.float32))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": wrap}


def _mesh(
    mi: ModuleType, name: str, vertices, faces, normals, uv, reflectances: tuple, colors: np.ndarray | None = None
):
    """Make a Mitsuba shape of triangles with these reflectances of front and back; `uv` (0, 0) is the top left, and v
    runs down.
    """
    front, back = ({"type": "diffuse", "reflectance": each} for each in reflectances)
    props = mi.Properties()
    props["bsdf"] = mi.load_dict({"type": "twosided", "front": front, "back": back})
    mesh = mi.Mesh(name, len(vertices), len(faces), has_vertex_normals=True, has_vertex_texcoords=True, props=props)
    if colors is not None:
        mesh.add_attribute("vertex_color", 3, np.ravel(colors).astype(np.float32))
    parameters = mi.traverse(mesh)
    for key, values in (("positions", vertices), ("normals", normals), ("texcoords", uv)):
        parameters[f"vertex_{key}"] = np.ravel(values).astype(np.float32)
    parameters["faces"] = np.ravel(faces).astype(np.uint32)
    parameters.update()
    return mesh
