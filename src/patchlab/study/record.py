"""Record networks' answers as short JSON values, and pair them across cells.

In: answers by shown thing (a design, a control). Out: per thing and network a text of 0 and 1, and confidences to five
digits; from results the rates, mean confidences and paired differences of tables. Cells of one scene, its networks and
a seed share draws of the evaluate stream, which training and selection never see.
"""

from collections.abc import Hashable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from patchlab.study.estimates import mean
from patchlab.study.study import Result
from patchproof.base.geometry import apply_homography
from patchproof.base.intervals import Estimate, estimate_difference, rate
from patchproof.evidence.results import Geometry
from patchproof.optimizer.responses import Responses


def to_record(answers: Mapping[str, Responses]) -> dict[str, Any]:
    """Hits and confidences as JSON values, each per shown thing and network."""
    return {
        "hits": {thing: [hits_text(row) for row in answer.recognized] for thing, answer in answers.items()},
        "confidence": {thing: np.round(answer.confidence, 5).tolist() for thing, answer in answers.items()},
    }


def hits_text(hits: Sequence[bool] | np.ndarray) -> str:
    """Write hits as a text of 0 and 1."""
    return "".join("01"[int(hit)] for hit in hits)


def parse_hits(text: str) -> list[bool]:
    """Read hits from a text of 0 and 1."""
    return [digit == "1" for digit in text]


def corner_error_mm(geometry: Geometry, corners_mm: np.ndarray, true_px: np.ndarray) -> float | None:
    """The largest error in mm of corners N×2 whose true pixels are `true_px`; None without a homography."""
    if geometry.homography_px_from_mm is None:
        return None
    seen_mm = apply_homography(np.linalg.inv(np.array(geometry.homography_px_from_mm)), true_px)
    return float(np.linalg.norm(seen_mm - corners_mm, axis=1).max())


class Record:
    """Hits and confidences of one shown thing over several results; taken from `answers[where]` if `where` is given.

    `network` may be None where every cell has a single network.
    """

    def __init__(self, results: Iterable[Result], thing: str, where: str | None = None):
        self._cells: dict[Hashable, tuple[Sequence[str], Mapping[str, Any]]] = {}
        for result in results:
            values, answers = result.cell.values, result.answers if where is None else result.answers[where]
            key = (values["name"], values["seed"], *values["networks"])
            self._cells[key] = values["networks"], {kind: answers[kind][thing] for kind in ("hits", "confidence")}

    def hits(self, network: str | None = None, among: Iterable[Hashable] | None = None) -> list[bool]:
        """Recognized or not, per condition."""
        return [hit for text in self._rows("hits", network, among) for hit in parse_hits(text)]

    def confidences(self, network: str | None = None, among: Iterable[Hashable] | None = None) -> list[float]:
        """The target's confidence, per condition."""
        return [value for row in self._rows("confidence", network, among) for value in row]

    def level(self, network: str | None = None) -> tuple[Estimate | None, Estimate | None]:
        """(rate, mean confidence) with intervals."""
        return rate(self.hits(network)), mean(self.confidences(network))

    def gain(self, other: "Record", network: str | None = None) -> tuple[Estimate | None, Estimate | None]:
        """(rate, mean confidence) minus those of `other`, paired by condition in the cells that both have."""
        shared = [key for key in self._cells if key in other._cells]
        pairs = zip(self.confidences(network, shared), other.confidences(network, shared), strict=True)
        return (
            estimate_difference(self.hits(network, shared), other.hits(network, shared)),
            mean([mine - others for mine, others in pairs]),
        )

    def _rows(self, kind: str, network: str | None, among: Iterable[Hashable] | None) -> list[Any]:
        chosen = (self._cells[key] for key in (self._cells if among is None else among))
        return [
            answers[kind][0 if network is None else networks.index(network)]
            for networks, answers in chosen
            if network is None or network in networks
        ]
