"""Find folders that are one session, by times, cameras, light and background; and the sessions of controls.

In: a `Grouping` by folders, measured photographs with their `Trace`s. Out: the grouping with such folders merged, and a
sentence that says so, or that nothing is known of them. Photographs of one camera within two minutes are one session,
unless folders of several look clearly different; within half an hour, or where times are unknown, like light and
background make one session: folders' means differ by no more than photographs within folders do.
Left out on purpose: dividing folders, which are somebody's word.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np

from patchproof.base.validation import summarize_names
from patchproof.evidence.grouping import BY_FOLDERS, PAUSE_MINUTES, Grouping
from patchproof.evidence.measure import MeasuredPhoto
from patchproof.evidence.results import Trace
from patchproof.evidence.verdict import PhotoKey

MOVE_MINUTES = 2.0
# Standard deviations within a session of the logarithms of red and blue over green on white paper, of both in the
# picture's frame, and of the frame's light over the paper's: 0.010, 0.011, 0.07, 0.13, 0.10 in 12 sessions of the demo;
# between these 0.03, 0.03, 0.6, 0.6, 0.4.
USUAL_SPREAD = np.array([0.012, 0.012, 0.12, 0.12, 0.12])
USUAL_WEIGHT = 16  # photographs that the usual spread stands for beside those of the folders
ALIKE, APART = 0.99, 0.999  # quantiles of the distance between two parts of one session


def merge_folders(grouping: Grouping, photos: Sequence[MeasuredPhoto]) -> Grouping:
    """Merge the folders that look like one session; `photos` are those of the grouping's paths."""
    if grouping.known_from != BY_FOLDERS or len(grouping.names) < 2:
        return grouping
    folders: list[list[MeasuredPhoto]] = [[] for _ in grouping.names]
    for photo, number in zip(photos, grouping.session, strict=True):
        folders[number].append(photo)
    looks = [np.array([look for photo in folder if (look := _look(photo)) is not None]) for folder in folders]
    several = [each for each in looks if len(each) > 1]
    freedom = USUAL_WEIGHT + sum(len(each) - 1 for each in several)
    variance = (USUAL_WEIGHT * USUAL_SPREAD**2 + sum(len(each) * each.var(0) for each in several)) / freedom
    same_as, unknown = list(range(len(folders))), set()
    for i, j in combinations(same_as.copy(), 2):
        share = _distance_share(looks[i], looks[j], variance, freedom)
        gap = min((_minutes_between(a.trace, b.trace) for a in folders[i] for b in folders[j]), default=np.nan)
        if np.isnan(gap):
            one = share is not None and share <= ALIKE
            unknown |= {i, j} if share is None else set()
        else:
            apart = share is not None and share > APART and min(len(looks[i]), len(looks[j])) > 1
            one = (gap <= MOVE_MINUTES and not apart) or (gap <= PAUSE_MINUTES and share is not None and share <= ALIKE)
        if one:
            old, new = max(same_as[i], same_as[j]), min(same_as[i], same_as[j])
            same_as = [new if number == old else number for number in same_as]
    count, names = len(set(same_as)), [name or "(no folder)" for name in grouping.names]
    notes = []
    if count < len(names):
        groups = ([name for name, number in zip(names, same_as, strict=True) if number == i] for i in set(same_as))
        text = "; ".join(sorted(summarize_names(group) for group in groups if len(group) > 1))
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
    pairs = list(zip(photos, grouping.merged, strict=True))
    numbers, taken = ({photo.entry.file: n for photo, n in pairs}, [(photo.trace, n) for photo, n in pairs])
    by_name: dict[str, list[str]] = {}
    for file in numbers:
        by_name.setdefault(file.rpartition("/")[2], []).append(file)
    folders = dict(zip(grouping.names, grouping.same_as or range(len(grouping.names)), strict=True))
    keys: dict[str, PhotoKey] = {}
    for photo in sorted(controls, key=lambda photo: photo.trace.minute or 0.0 if photo.trace else 0.0):
        file, folder, name = photo.entry.file, *photo.entry.file.rpartition("/")[::2]
        partners = [file] if folder and file in numbers else [] if folder else by_name.get(name, [])
        near = [number for other, number in taken if _minutes_between(photo.trace, other) <= PAUSE_MINUTES]
        if folder in folders and folder:
            session = folders[folder]
        elif len(partners) == 1:
            session = numbers[partners[0]]
        else:
            earlier = (key[0] for other, key in keys.items() if key[0] < 0 and other.rpartition("/")[0] == folder)
            lone = folder or photo.trace is None or photo.trace.minute is None
            new = next(earlier, None) if lone else None
            session = near[-1] if near else new or -1 - sum(1 for _ in keys)
        taken.append((photo.trace, session))
        keys[file] = session, partners[0] if len(partners) == 1 else f"/{file}"
    return keys


def _minutes_between(trace: Trace | None, other: Trace | None) -> float:
    """Minutes between photographs of one camera: infinity for two cameras, NaN if times are unknown."""
    if trace is None or other is None or trace.minute is None or other.minute is None:
        return np.nan
    return abs(trace.minute - other.minute) if trace.camera == other.camera else np.inf


def _look(photo: MeasuredPhoto) -> np.ndarray | None:
    """A photograph's light and background, as `USUAL_SPREAD` lists them; None if its light is unknown."""
    if photo.light is None or photo.trace is None or not photo.counted:
        return None
    paper, frame = (np.log(np.maximum(light, 1e-3)) for light in (photo.light.paper, photo.trace.frame))
    return np.array([*(paper - paper[1])[::2], *(frame - frame[1])[::2], frame[1] - paper[1]])


def _distance_share(a: np.ndarray, b: np.ndarray, variance: np.ndarray, freedom: int) -> float | None:
    """The share of pairs of parts of one session that are more alike than two folders' looks; None if unknown."""
    from scipy.special import fdtr

    if not len(a) or not len(b):
        return None
    ratio = float(((a.mean(0) - b.mean(0)) ** 2 / variance).mean()) / (1 / len(a) + 1 / len(b))
    return float(fdtr(len(variance), freedom, ratio))
