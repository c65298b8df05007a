"""Compare photographs by real cameras with our channel's rendering of the same print.

In: photographs of printed boards of markers, whose pattern is known. Each board is found, its light, printed black and
blur are fitted (`board_fit`), and print, light and camera of our channel render it again in its place. Out, by
photograph: the residual in code values, edge widths, blur, noise, light and black beside the defaults of scenes; and
the change of networks' answers when the rendering replaces the board, beside two harmless changes: the photograph saved
again as JPEG, or moved by half a pixel. Unusable photographs are listed with the reason. Photographs by one camera are
not independent, so medians have no intervals.
Left out on purpose: color, since boards are black and white; distances and angles, as these cameras are not calibrated.
"""

import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import cv2
import numpy as np
import torch
from pydantic import Field

from patchlab.study.figures import picture_sheet
from patchlab.study.grid import cached_network
from patchlab.study.study import Cell, Result, Study
from patchlab.validation.board_fit import BoardFit, edge_profile, fit_board, white_noise
from patchlab.validation.marker_boards import BoardPose, BoardSettings, find_board
from patchproof.base.color import LUMINANCE, linear_from_srgb
from patchproof.base.geometry import rect_corners
from patchproof.base.output import image_bytes, image_pixels
from patchproof.base.settings import CameraSettings, PrinterSettings
from patchproof.base.validation import StrictModel, expand_path
from patchproof.channel.printer import load_printer
from patchproof.classifier.network import Classifier
from patchproof.optimizer.subject import from_pixels
from patchproof.photo.read import list_photos, read_photo
from patchproof.photo.rectify import region_around
from patchproof.photo.rejection import PhotoRejected
from patchproof.report.page import png
from patchproof.report.tables import Drawing, Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_JPEG_QUALITY, _SHIFT_PX = 90, 0.5
_CHANGES = ("our rendering", f"JPEG {_JPEG_QUALITY}", "half a pixel")
_PANEL_PX, _MARGIN_PX = (480, 360), 6
_DIFFERENCE_GAIN = 2  # factor of the difference in pictures
_PHOTOS_PER_SHEET = 5
# names of figures in tables, by key
_FIGURES = {
    "residual_rms": "what is left, RMS, code values",
    "residual_p95": "what is left, 95 % point, code values",
    "edge_photo_px": "edge width 10-90 % in the photograph, px",
    "edge_ours_px": "edge width 10-90 % in our rendering, px",
    "overshoot": "overshoot at edges in the photograph, share of the contrast",
    "blur_px": "blur, Gaussian sigma, px",
    "noise": "noise at white",
    "black": "printed black over paper, linear light",
    "light_range": "most over least light on the board",
    "uneven": "white paper off the fitted light, RMS share",
    "misfit_px": "corners off the plane, RMS, px",
    "bend_px": "pattern off the homography, RMS, px",
    "module_px": "side of a module, px",
}


class RealSettings(StrictModel):
    """Photographs of boards, and the networks that are asked about them."""

    boards: Annotated[dict[str, BoardSettings], Field(min_length=1)]  # by name of camera and board
    networks: tuple[str, ...] = ("builtin",)  # networks whose answers are compared


def cells(settings: RealSettings, base: Path) -> list[Cell]:
    """A cell per photograph."""
    photos = []
    for name, board in settings.boards.items():
        for text in board.photos:
            path = Path(expand_path(text, base))
            files = [text] if path.is_file() else [f"{text}/{file.name}" for file in list_photos(path)]
            photos += [{"board": name, "photo": file} for file in files]
    return [Cell(f"photo_{i:03d}", values) for i, values in enumerate(photos)]


def run(settings: RealSettings, base: Path, cell: Cell) -> dict[str, Any]:
    """Figures of one photograph, changes by network, and a picture; or the reason why it was left out."""
    try:
        srgb = read_photo(expand_path(cell.values["photo"], base)).srgb
        pose = find_board(srgb, settings.boards[cell.values["board"]])
        fit = fit_board(srgb, pose)
    except PhotoRejected as error:
        return {"left_out": error.advice}
    ours = fit.rendered()
    pasted = np.where(fit.mask[..., None], ours, srgb)
    networks = {name: _measure_changes(cached_network(name, base), srgb, pasted) for name in settings.networks}
    answers = {"left_out": None, **_photo_figures(srgb, ours, pose, fit), "networks": networks}
    return answers | {f"{cell.name}.png": _compare_pictures(srgb, pasted, fit)}


def _photo_figures(srgb: np.ndarray, ours: np.ndarray, pose: BoardPose, fit: BoardFit) -> dict[str, Any]:
    residual = (srgb.astype(float) - ours)[fit.mask]
    edge_photo, overshoot = edge_profile(fit.paper_seen(srgb), fit.prints, pose.module_px)
    noise, uneven = white_noise(fit, srgb)
    paper = (fit.light @ np.array(LUMINANCE))[fit.mask]
    return {
        "markers": f"{pose.found} of {pose.expected}",
        "residual_rms": float(np.sqrt((residual**2).mean())),
        "residual_p95": float(np.percentile(np.abs(residual), 95)),
        "edge_photo_px": edge_photo,
        "edge_ours_px": edge_profile(fit.paper_seen(ours), fit.prints, pose.module_px)[0],
        "overshoot": overshoot,
        "blur_px": fit.blur_px,
        "noise": noise,
        "black": float(fit.black @ np.array(LUMINANCE)),
        "light_range": float(paper.max() / max(paper.min(), 1e-4)),
        "uneven": uneven,
        "misfit_px": pose.misfit_px,
        "bend_px": fit.bend_px,
        "module_px": pose.module_px,
        "clipped": fit.clipped,
    }


def _measure_changes(network: Classifier, srgb: np.ndarray, pasted: np.ndarray) -> dict[str, Any]:
    """By change: if the label changed, the change of its confidence, the RMS change of log-probabilities."""
    again = image_pixels(image_bytes(srgb, "JPEG", {"quality": _JPEG_QUALITY}))
    by_half = np.array([[1, 0, _SHIFT_PX], [0, 1, 0]])
    beside = cv2.warpAffine(srgb, by_half, srgb.shape[1::-1], flags=cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
    with torch.inference_mode():
        logits = [network.logits(from_pixels(picture)[None]) for picture in (srgb, pasted, again, beside)]
    logs = [torch.log_softmax(each.double(), 1)[0].numpy() for each in logits]
    before, best = logs[0], int(logs[0].argmax())
    found: dict[str, Any] = {"label": network.labels[best], "confidence": float(np.exp(before[best]))}
    for name, after in zip(_CHANGES, logs[1:], strict=True):
        found[name] = {
            "changed": int(after.argmax()) != best,
            "confidence": float(np.exp(after[best]) - np.exp(before[best])),
            "log_rms": float(np.sqrt(((after - before) ** 2).mean())),
        }
    return found


def _compare_pictures(srgb: np.ndarray, pasted: np.ndarray, fit: BoardFit) -> bytes:
    """PNG of the photograph, the rendering in its place, and their difference around gray, cropped to the board."""
    rows, columns = np.nonzero(fit.mask)
    corners = rect_corners((columns.min(), rows.min(), np.ptp(columns) + 1, np.ptp(rows) + 1))
    box = region_around(corners, _MARGIN_PX, srgb.shape)
    difference = np.clip(128 + _DIFFERENCE_GAIN * (srgb.astype(float) - pasted), 0, 255).astype(np.uint8)
    return png(np.concatenate([_panel(picture[box]) for picture in (srgb, pasted, difference)], 1))


def _panel(picture: np.ndarray) -> np.ndarray:
    panel = np.full((_PANEL_PX[1], _PANEL_PX[0], 3), 255, np.uint8)
    scale = min((_PANEL_PX[0] - 8) / picture.shape[1], _PANEL_PX[1] / picture.shape[0])
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST)
    left, top = (_PANEL_PX[0] - size[0]) // 2, (_PANEL_PX[1] - size[1]) // 2
    panel[top : top + size[1], left : left + size[0]] = picture
    return panel


def tables(settings: RealSettings, results: Sequence[Result]) -> Sequence[Table]:
    """Tables: medians by board, networks by board, every photograph, photographs left out."""
    return _by_board(settings, results), _by_network(settings, results), _photographs(results), _left_out(results)


def _used_results(results: Sequence[Result], board: str | None = None) -> list[Result]:
    of_board = [result for result in results if board in (None, result.cell.values["board"])]
    return [result for result in of_board if result.answers["left_out"] is None]


def _by_board(settings: RealSettings, results: Sequence[Result]) -> Table:
    rows = []
    for board in settings.boards:
        for key, words in _FIGURES.items():
            values = [result.answers[key] for result in _used_results(results, board)]
            if values := [value for value in values if value is not None]:
                rows.append((board, words, statistics.median(values), min(values), max(values), len(values)))
    head = ("board", "figure", "median", "least", "most", "photographs")
    return Table("boards", "By board and camera", head, tuple(rows), "photographs by one camera are one case")


def _by_network(settings: RealSettings, results: Sequence[Result]) -> Table:
    rows = []
    for board in settings.boards:
        for network in settings.networks if _used_results(results, board) else ():
            answers = [result.answers["networks"][network] for result in _used_results(results, board)]
            for change in _CHANGES:
                each = [answer[change] for answer in answers]
                labels = sum(one["changed"] for one in each)
                moves = [statistics.median(abs(one[key]) for one in each) for key in ("confidence", "log_rms")]
                rows.append((board, Path(network).stem, change, len(each), labels, *moves))
    head = ("board", "network", "change", "photographs", "other labels", "confidence moved", "log-probabilities moved")
    about = "medians over photographs; the board replaced by our rendering of it, or all of the photograph changed"
    return Table("networks", "How far networks' answers move", head, tuple(rows), about)


def _photographs(results: Sequence[Result]) -> Table:
    rows = tuple(
        (*_names(result), result.answers["markers"], *(result.answers[key] for key in (*_FIGURES, "clipped")))
        for result in _used_results(results)
    )
    head = ("board", "photograph", "markers", *_FIGURES.values(), "share of the board at full white")
    return Table("photographs", "Every photograph", head, rows)


def _left_out(results: Sequence[Result]) -> Table:
    out = [result for result in results if result.answers["left_out"] is not None]
    rows = tuple((*_names(result), result.answers["left_out"]) for result in out)
    return Table("left_out", "Photographs left out", ("board", "photograph", "why"), rows)


def _names(result: Result) -> tuple[str, str]:
    return result.cell.values["board"], Path(result.cell.values["photo"]).name


def figures(settings: RealSettings, results: Sequence[Result]) -> Sequence[Drawing]:
    """A plot of fitted figures over the ranges of scenes, and every photograph with its rendering."""
    used = _used_results(results)
    if not used:
        return ()
    title = "What scenes draw from (gray), and photographs"
    drawings = [Drawing("ranges", title, _range_plot(settings, used), (9.0, 3.0))]
    columns = ("photograph", "our rendering in its place", f"difference × {_DIFFERENCE_GAIN}, gray where equal")
    for first in range(0, len(used), _PHOTOS_PER_SHEET):
        some = used[first : first + _PHOTOS_PER_SHEET]
        files = [(_caption(result), result.file(f"{result.cell.name}.png")) for result in some]
        title, size_in = f"Photographs {first + 1} to {first + len(some)}", (11.0, 3.0 * len(some))
        drawings.append(picture_sheet(f"pictures_{first:03d}", title, files, size_in, columns=columns))
    return drawings


def _caption(result: Result) -> str:
    answers = result.answers
    left = f"{answers['residual_rms']:.1f} code values left, blur {answers['blur_px']:.2f} px"
    return f"{' / '.join(_names(result))}: {left}, black {answers['black']:.3f}"


def _range_plot(settings: RealSettings, used: Sequence[Result]):
    camera, printer = CameraSettings(), PrinterSettings()
    ink = load_printer(printer.profile).apply(torch.zeros(1, 3, 2, 2))[0, :, 0, 0].double().numpy()
    black = float(linear_from_srgb(ink) @ np.array(LUMINANCE))
    ranges = {
        "blur_px": camera.blur_px,
        "noise": camera.noise,
        "black": tuple(black + veil * (1 - black) for veil in printer.veil),
    }

    def draw(figure: "Figure") -> None:
        for axes, (key, (low, high)) in zip(figure.subplots(1, 3, sharey=True), ranges.items(), strict=True):
            axes.axvspan(low, high, color="0.85")
            for row, board in enumerate(settings.boards):
                values = [each.answers[key] for each in _used_results(used, board) if each.answers[key] is not None]
                axes.plot(values, [row] * len(values), "o", alpha=0.5, markersize=5)
            axes.set_xlabel(_FIGURES[key])
            axes.set_yticks(range(len(settings.boards)), list(settings.boards))
            axes.set_ylim(len(settings.boards) - 0.5, -0.5)

    return draw


STUDY = Study("real", RealSettings, cells, run, tables, figures)
