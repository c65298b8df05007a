"""Group photographs into sessions, taken in one go in one place and light with one camera, and reject copies in them.

In: the folder of the photographs; then the measured photographs with their `Trace`s. Out: a `Grouping`, and how it is
known. Folders in the folder are sessions, but folders that look like one session are merged, with a sentence that says
so, or that nothing is known of them: photographs of one camera within two minutes are one session, unless folders of
several look clearly different; within half an hour, or where times are unknown, like light and background make one
session: the means of what is joined so far differ by no more than photographs within folders do. Without folders, times
decide: another camera, or a pause of half an hour, begins a new session. Without times all are one session: the
cautious assumption, since photographs of one session count for less. Also: the sessions of controls.
Copies count once: files with equal bytes, and in a session those in which light and the sheet's place differ by no more
than between two shots of a hand-held camera: a centimeter in half a meter, a degree or two, an aim that is off by a
hundredth of the picture, exposures that differ by a fourteenth of a stop. A crop that keeps its pixels is a copy, too,
and so is a picture of other brightness in which the sheet lies where it lay but for noise: an edit, or from a tripod.
Left out on purpose: dividing folders, which are somebody's word; copies without a readable sheet that differ in bytes.
"""

import math
from bisect import bisect, insort
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from patchproof.base.geometry import apply_homography, rect_corners
from patchproof.base.input import is_folder
from patchproof.base.text import printable
from patchproof.base.validation import summarize_names
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import PhotoEntry, Remark, Trace
from patchproof.evidence.verdict import PhotoKey
from patchproof.photo.read import list_images, list_photos, subfolders
from patchproof.sheets.manifest import Rect

PAUSE_MINUTES, MOVE_MINUTES = 30.0, 2.0
BY_FOLDERS, BY_TIMES, BY_GUESS = "folders", "cameras and times", "no folders or times"
# Standard deviations within a session of the logarithms of red and blue over green on white paper, of both in the
# picture's frame, and of the frame's light over the paper's: 0.010, 0.011, 0.07, 0.13, 0.10 in 12 sessions of the demo;
# between these 0.03, 0.03, 0.6, 0.6, 0.4.
USUAL_SPREAD = np.array([0.012, 0.012, 0.12, 0.12, 0.12])
USUAL_WEIGHT = 16  # photographs that the usual spread stands for beside those of the folders
ALIKE, APART = 0.99, 0.999  # quantiles of the distance between two parts of one session
COPY_CODE = "copy"
# Largest differences between two shots of one view. Of 800 views drawn from the default ranges, in sessions of 40, none
# is taken for another (2 are with a shape tolerance of 0.02).
SCALE_TOLERANCE, TILT_TOLERANCE = 0.02, 0.02  # relative of pixels per mm, absolute of the tilt's cosine
LIGHT_TOLERANCE = 0.05  # relative, of the light of white paper
AIM_TOLERANCE = 0.01  # of the picture's longer side
SHAPE_TOLERANCE = 0.01  # of the design's longer side: offset of its corners about its middle
CROP_TOLERANCE = 0.2  # of those of scale and shape, in which a photograph and its crop are equal but for noise
# Figures of a view: place of the middle and scale in the picture, pixels per mm, shape of four corners, session, tilt,
# light in three colors. A crop changes the first three.
_FIGURES, _IN_PICTURE, _OF_CROPS, _ANYWHERE, _IN_LIGHT = 17, slice(3), slice(3, 12), slice(4, 14), slice(14, None)
_OF_EDITS = np.r_[0:3, 4:12]  # which may have another size, too
_UNKNOWN = 1e9  # in place of an unknown figure, which is like other unknown ones


@dataclass(frozen=True)
class Grouping:
    """Photographs, the number of each one's session, the sessions' names, and in a few words how they are known."""

    paths: tuple[Path, ...]
    session: tuple[int, ...]
    names: tuple[str, ...]
    known_from: str
    same_as: tuple[int, ...] = ()  # the number of the session that each one is part of; itself if empty
    note: str = ""  # how they were merged, or that this could not be checked

    @property
    def merged(self) -> tuple[int, ...]:
        """The number of each photograph's session, as merged."""
        return tuple(self.same_as[number] for number in self.session) if self.same_as else self.session

    def file(self, number: int) -> str:
        """Name the photograph in reports: FILE, or FOLDER/FILE where folders are sessions."""
        folder, path = self.names[self.session[number]], self.paths[number]
        name, parent = printable(path.name), printable(path.parent.name)
        return f"{folder}/{name}" if parent == folder and self.known_from == BY_FOLDERS else name


def group_sessions(folder: str | Path, without: Path | None = None) -> Grouping:
    """Group the photographs of a folder or at a path, but those in the folder `without`; refused if there are none."""
    folder, excluded = Path(folder), None if without is None else without.resolve()
    folders = [p for p in subfolders(folder) if p.resolve() != excluded] if is_folder(folder) else []
    sessions = {printable(p.name): paths for p in folders if (paths := list_images(p))}
    if not sessions:
        paths = list_photos(folder)
        return Grouping(tuple(paths), (0,) * len(paths), ("",), BY_GUESS)
    if loose := list_images(folder):
        sessions = {"": loose} | sessions
    pairs = [(path, number) for number, paths in enumerate(sessions.values()) for path in paths]
    return Grouping(tuple(p for p, _ in pairs), tuple(n for _, n in pairs), tuple(sessions), BY_FOLDERS)


def _group_by_times(grouping: Grouping, photos: Sequence[MeasuredPhoto]) -> Grouping:
    """Divide photographs without folders by cameras and times, if all that can be read have them."""
    traces = [(photo.trace, number) for number, photo in enumerate(photos) if photo.trace is not None]
    timed = sorted((t.minute, t.camera, number) for t, number in traces if t.minute is not None)
    if not timed or len(timed) < len(traces):
        return grouping
    sessions, names, last = [0] * len(photos), [], {}
    for minute, camera, number in timed:
        last_minute, session = last.get(camera, (-np.inf, 0))
        if minute - last_minute > PAUSE_MINUTES + 1e-4:  # of floats that count minutes since the year 1
            session = len(names)
            names.append(f"{datetime.min + timedelta(minutes=minute):%Y-%m-%d %H:%M} {camera}".strip())
        sessions[number], last[camera] = session, (minute, session)
    return replace(grouping, session=tuple(sessions), names=tuple(names), known_from=BY_TIMES)


def merge_folders(grouping: Grouping, photos: Sequence[MeasuredPhoto]) -> Grouping:
    """Merge folders that look like one session, or divide `photos` without folders by cameras and times."""
    if grouping.known_from != BY_FOLDERS:
        return _group_by_times(grouping, photos)
    if len(grouping.names) < 2:
        return grouping
    looks: list[list[np.ndarray]] = [[] for _ in grouping.names]
    timed: list[tuple[str, float, int]] = []
    for photo, number in zip(photos, grouping.session, strict=True):
        looks[number] += [look] if (look := _look(photo)) is not None else []
        if photo.trace is not None and photo.trace.minute is not None:
            timed.append((photo.trace.camera, photo.trace.minute, number))
    several = [np.array(each) for each in looks if len(each) > 1]
    freedom = USUAL_WEIGHT + sum(len(each) - 1 for each in several)
    variance = (USUAL_WEIGHT * USUAL_SPREAD**2 + sum(len(each) * each.var(0) for each in several)) / freedom
    means = np.array([np.mean(look, 0) if look else np.full(len(variance), np.nan) for look in looks])
    counts = np.array([len(look) for look in looks])
    shares = partial(_distance_shares, variance, freedom)
    same_as, near = np.arange(len(looks)), dict[int, set[int]]()
    untimed = np.setdiff1d(same_as, [number for *_, number in timed])
    for (i, j), gap in _minutes_apart(sorted(timed)).items():
        near.setdefault(i, set()).add(j)
        near.setdefault(j, set()).add(i)
        few = min(counts[i], counts[j]) < 2
        if gap <= MOVE_MINUTES and (few or shares(means[i], counts[i], means[j], counts[j]) <= APART):
            _join(same_as, [i, j])
    _join_alike(same_as, means, counts, shares, near, untimed)
    unread = np.flatnonzero(counts == 0).tolist()
    unknown, same_as = {*untimed.tolist(), *unread} if len(untimed) and unread else set(), same_as.tolist()
    names, groups, notes = [name or "(no folder)" for name in grouping.names], dict[int, list[str]](), []
    for name, number in zip(names, same_as, strict=True):
        groups.setdefault(number, []).append(name)
    if (count := len(groups)) < len(names):
        text = "; ".join(sorted(summarize_names(group) for group in groups.values() if len(group) > 1))
        notes.append(f"{len(names)} folders look like {count} sessions, by times, light and background: {text}")
    if unknown:
        text = summarize_names([names[i] for i in sorted(unknown)])
        notes.append(f"could not be checked to be different sessions, for want of times and of light: {text}")
    return replace(grouping, same_as=tuple(same_as), note="; ".join(notes))


def control_keys(
    grouping: Grouping, photos: Sequence[MeasuredPhoto], controls: Sequence[MeasuredPhoto]
) -> dict[str, PhotoKey]:
    """By a control's photograph: its session, and the name of the patch's photograph that it is a pair of, or its own.
    It belongs to the patch's session whose folder has the name of its folder, which has the only photograph of its
    name, or one of its camera within half an hour; else to one of its own, by folder and time (numbers below 0).
    """
    numbers: dict[str, int] = {}
    taken: dict[str, list[tuple[float, int, int]]] = {}  # by camera: minute, place in the order taken here, session
    for place, (photo, session) in enumerate(zip(photos, grouping.merged, strict=True)):
        numbers[photo.entry.file] = session
        minute, rows = _times_of(photo.trace, taken)
        insort(rows, (minute, place, session))
    own: dict[str, int] = {}  # by folder: the control's first session of its own
    by_name: dict[str, list[str]] = {}
    for file in numbers:
        by_name.setdefault(file.rpartition("/")[2], []).append(file)
    folders = dict(zip(grouping.names, grouping.same_as or range(len(grouping.names)), strict=True))
    keys: dict[str, PhotoKey] = {}
    for photo in sorted(controls, key=lambda photo: photo.trace.minute or 0.0 if photo.trace else 0.0):
        file, folder, name = photo.entry.file, *photo.entry.file.rpartition("/")[::2]
        partners = [file] if folder and file in numbers else [] if folder else by_name.get(name, [])
        minute, rows = _times_of(photo.trace, taken)
        near = rows[bisect(rows, (minute - PAUSE_MINUTES,)) : bisect(rows, (minute + PAUSE_MINUTES, np.inf))]
        if folder in folders and folder:
            session = folders[folder]
        elif len(partners) == 1:
            session = numbers[partners[0]]
        else:
            lone = folder or photo.trace is None or photo.trace.minute is None
            new = own.get(folder) if lone else None
            session = max(near, key=lambda row: row[1])[2] if near else new or -1 - len(keys)
        if session < 0:
            own.setdefault(folder, session)
        insort(rows, (minute, len(photos) + len(keys), session))
        keys[file] = session, partners[0] if len(partners) == 1 else f"/{file}"
    return keys


def _times_of(trace: Trace | None, taken: dict[str, list]) -> tuple[float, list]:
    """A photograph's minute, and the list of its camera in `taken`; a new list if its time is unknown."""
    if trace is None or trace.minute is None:
        return 0.0, []
    return trace.minute, taken.setdefault(trace.camera, [])


def _minutes_apart(timed: Sequence[tuple[str, float, int]]) -> dict[tuple[int, int], float]:
    """Minutes between the nearest photographs of one camera in two folders, where they are at most `PAUSE_MINUTES`;
    `timed` are cameras, minutes and folders in order.
    """
    gaps, last, former = {}, {}, None
    for camera, minute, number in timed:
        near = last.items() if camera == former else ()
        last, former = {other: time for other, time in near if minute - time <= PAUSE_MINUTES}, camera
        for other in last.keys() - {number}:
            pair = min(number, other), max(number, other)
            gaps[pair] = min(gaps.get(pair, np.inf), minute - last[other])
        last[number] = minute
    return gaps


def _join_alike(
    same_as: np.ndarray, means: np.ndarray, counts: np.ndarray, shares: Any, near: Any, untimed: Any
) -> None:
    """Join each group to the earlier one that it is most like, if these are alike and `near` in time, or the time of a
    folder is unknown. Means of whole groups are compared: chance would chain single folders of different sessions.
    """
    total, number = np.zeros_like(means), np.bincount(same_as, counts, len(counts))
    np.add.at(total, same_as, np.nan_to_num(means) * counts[:, None])
    free, first = np.zeros((2, len(counts)), bool)
    free[same_as[untimed]] = True
    for i in np.unique(same_as).tolist():
        allowed = free | free[i]
        allowed[[same_as[j] for folder in np.flatnonzero(same_as == i).tolist() for j in near.get(folder, ())]] = True
        rows = np.flatnonzero(allowed & first & (number > 0))
        share = shares(total[rows] / number[rows, None], number[rows], total[i] / max(number[i], 1), number[i])
        if number[i] and share.min(initial=1.0) <= ALIKE:
            group = int(rows[share.argmin()])
            for values in (total, number, free):
                values[group] += values[i]
            _join(same_as, [group, i])
        else:
            first[i] = True


def _join(same_as: np.ndarray, folders: list[int] | np.ndarray) -> None:
    """Make one session, named by its first folder, of all that these folders are part of."""
    numbers = same_as[folders]
    if (numbers != numbers[0]).any():
        same_as[np.isin(same_as, numbers)] = numbers.min()


def _look(photo: MeasuredPhoto) -> np.ndarray | None:
    """A photograph's light and background, as `USUAL_SPREAD` lists them; None if its light is unknown."""
    if photo.light is None or photo.trace is None or not photo.counted:
        return None
    paper, frame = (np.log(np.maximum(light, 1e-3)) for light in (photo.light.paper, photo.trace.frame))
    return np.array([*(paper - paper[1])[::2], *(frame - frame[1])[::2], frame[1] - paper[1]])


def _distance_shares(
    variance: np.ndarray, freedom: int, looks: np.ndarray, photos: Any, look: np.ndarray, count: Any
) -> np.ndarray:
    """The shares of pairs of parts of one session, of `photos` and `count`, that are more alike than those with the
    mean `looks` and the one with the mean `look`.
    """
    from scipy.special import fdtr

    with np.errstate(divide="ignore"):  # of folders without looks
        noise = 1 / np.asarray(photos) + 1 / np.asarray(count)
    return fdtr(len(variance), freedom, ((looks - look) ** 2 / variance).mean(-1) / noise)


def reject_copies(photos: Sequence[MeasuredPhoto], session: Sequence[int], rect_mm: Rect) -> list[MeasuredPhoto]:
    """Reject every photograph that repeats a larger or an earlier one; the design lies at `rect_mm` of the page."""
    seen = [_view(photo, number, rect_mm) for photo, number in zip(photos, session, strict=True)]
    rows = [row for row, view in enumerate(seen) if view is not None]
    index_of = {row: index for index, row in enumerate(rows)}
    views = np.array([seen[row] for row in rows]).reshape(-1, _FIGURES)
    anywhere = np.nan_to_num(views[:, _ANYWHERE], nan=_UNKNOWN)
    tree = KDTree(anywhere)  # so that a view is compared with those near it alone
    first_by_sha256: dict[str, PhotoEntry] = {}
    first_by_row: dict[int, PhotoEntry] = {}
    results = list(photos)
    for row in sorted(range(len(photos)), key=lambda row: -math.prod(photos[row].entry.photo_px or (0,))):
        entry = photos[row].entry
        first = None if entry.sha256 is None else first_by_sha256.get(entry.sha256)
        advice = "its bytes are those of {}, which counts once: leave it out"
        if first is None:
            first = first_by_row.get(row)
            advice = "it shows what {} shows, from there, and counts once: take another view"
        if first is None:
            first_by_sha256 |= {} if entry.sha256 is None else {entry.sha256: entry}
            if (index := index_of.get(row)) is not None:
                near = np.array(tree.query_ball_point(anywhere[index], 1, p=np.inf))
                for same in near[_is_repeated(views[index], views[near])]:
                    first_by_row.setdefault(rows[same], entry)
        else:
            remark = Remark(code=COPY_CODE, advice=advice.format(first.file))
            results[row] = replace(photos[row], entry=entry.changed(status="rejected", remark=remark), counted=False)
    return results


def _view(photo: MeasuredPhoto, session: int, rect_mm: Rect) -> np.ndarray | None:
    """Describe session, pose and light by `_FIGURES` in units of their tolerance (NaN: unknown); None for a photograph
    that is not counted, or whose geometry or light is unknown.
    """
    geometry, size_px = photo.entry.geometry, photo.entry.photo_px
    if not photo.counted or geometry is None or photo.light is None or size_px is None:
        return None
    light = np.log(np.maximum(photo.light.paper, 1e-3)) / LIGHT_TOLERANCE
    scales = np.log(geometry.px_per_mm / np.array([max(size_px), 1])) / SCALE_TOLERANCE
    tilt = np.nan if geometry.tilt_deg is None else np.cos(np.radians(geometry.tilt_deg)) / TILT_TOLERANCE
    corners = np.full((4, 2), np.nan)  # unknown on rolled paper
    if geometry.homography_px_from_mm is not None:
        corners = apply_homography(np.array(geometry.homography_px_from_mm), rect_corners(rect_mm))
        corners = (corners - np.array(size_px) / 2) / max(size_px)
        across = corners[1] + corners[2] - corners[0] - corners[3]
        quarter_turns = round(float(np.arctan2(across[1], across[0]) / (np.pi / 2)))  # a turned copy is a copy
        corners = corners @ np.linalg.matrix_power([[0, -1], [1, 0]], quarter_turns % 4)
    middle = corners.mean(0)
    side = geometry.px_per_mm * max(rect_mm[2:]) / max(size_px)
    shape = (corners - middle) / side / SHAPE_TOLERANCE
    return np.array([*(middle / AIM_TOLERANCE), *scales, *shape.ravel(), 2 * session, tilt, *light])


def _is_repeated(view: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Whether each of the views N×F, alike but for light and place in the picture, is this one, cropped or edited."""
    off = np.abs(others - view)
    same_light, same_place = np.all(off[:, _IN_LIGHT] <= 1, 1), np.logical_not(np.any(off[:, _IN_PICTURE] > 1, 1))
    crop, edit = (np.all(off[:, figures] <= CROP_TOLERANCE, 1) for figures in (_OF_CROPS, _OF_EDITS))
    return np.logical_or(np.logical_and(same_light, np.logical_or(same_place, crop)), edit)
