"""`place = "auto"`: where on the object a design reaches most, found with less than a quarter of what a run costs.

In: an `UnplacedScene` and its networks. Out: `Place`. Places all over the surface (see `scene.places`) are compared in the
same views, those of `patch.side`, in three steps. Screening: what a gray design costs at each place, and what its
gradient promises to win back. Turns: the same for the other spins of the few best. Drafts: the best get a few steps of
the real loop, and views that none has seen decide. Screening and drafts see draws of the train stream, the decision
those of the select stream; the promise's are never touched. The same scene and seed give the same place.

Left out on purpose: whether the runner-up would win with more steps or another seed. The interval is over views alone,
and as the best of a few is named for being it, it flatters a little.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from patchproof.base.compute import Compute
from patchproof.base.errors import Refused
from patchproof.base.intervals import student_mean
from patchproof.base.progress import Advance, Progress, no_progress
from patchproof.base.settings import OptimizeSettings
from patchproof.base.validation import Side, StrictModel
from patchproof.base.workers import fork_workers
from patchproof.classifier.network import Classifier
from patchproof.optimizer.expectation import gradient_in_views
from patchproof.optimizer.loop import draft, start, views_per_network
from patchproof.optimizer.losses import Loss
from patchproof.optimizer.pixels import as_pixels, from_pixels
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.promise import min_promise_passes
from patchproof.optimizer.responses import responses
from patchproof.optimizer.training_views import training_views
from patchproof.render.pixels import Appearance
from patchproof.scene.candidate_places import MIN_DISTANCE_SHARE, CandidatePlace, PlaceFinder
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene
from patchproof.scene.open_scene import UnplacedScene, require_unplaced
from patchproof.scene.patch_scene import PiecePosition

PASSES = 608  # at most: pictures that go through a network, and once more those that gradients come back through
PLACES, SCREEN_VIEWS = 24, 4  # 192 of them, and 4 of the bare object
TURNED = 4  # of the best places, with at most three turns each: 96
# What is left, 18 steps at least. Of as many views, 18 steps of 2 got 0.02 to 0.03 further than 9 of 4 (two places on
# the demo's truck).
DRAFTS, DRAFT_VIEWS, HELD_OUT_VIEWS = 3, 2, 24
_REACH = 0.1  # of sRGB's range: so far a gradient is believed


class Candidate(StrictModel):
    """A place that was tried. Losses are less the bare object's in the same views: lower is better for the goal.
    `outlook` is `gray` less what the gradient promises, `draft` that of a drafted design in held-out views.
    """

    at: PiecePosition
    spin_deg: float
    family: str
    gap_mm: float
    overhang_share: float
    gray: float
    outlook: float
    draft: float | None = None


class Lead(StrictModel):
    """How much lower the chosen draft's loss is than the runner-up's in the same held-out views, with its 95 %
    interval, and whether that leaves chance no room.
    """

    value: float
    interval: tuple[float, float]
    sure: bool


class Place(StrictModel):
    """The place that a search chose, as the keys `patch.at_mm` (or `patch.side`), `patch.spin_deg` and `view.front` say
    it. Candidates run from the best to the worst. `passes` are those of each network, `run_share` is their share of a
    default run's.
    """

    sheet_id: str  # of the scene that was searched
    front: Side
    at: PiecePosition
    spin_deg: float
    lead: Lead | None  # None where no other place was drafted
    passes: int
    run_share: float
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True, eq=False)
class _ScreenedPlace:
    """A spot, the problem with the piece there, and what screening said."""

    spot: CandidatePlace
    problem: Problem
    gray: float
    outlook: float


def choose_place(
    scene: Scene,
    *,
    models: Sequence[str | Classifier] | None = None,
    loss: Loss | None = None,
    compute: Compute = Compute(),
    progress: Progress = no_progress,
) -> Place:
    """Search the object of a scene with `patch.place = "auto"` for the best place of the piece.

    Args:
        scene: loaded by `load_scene` or `make_scene`; `scene.at(place.at, place.spin_deg)` has the piece there.
        models, loss: networks and loss in place of the scene's, as in `optimize`.
        compute: device and processes; refuses a cluster.
        progress: called with the stage "place" (passes of the networks).

    Raises:
        Refused: where the piece fits nowhere on the object.
    """
    scene, compute, advance = (
        require_unplaced(scene),
        compute.without("choose_place", cluster=True),
        partial(progress, "place"),
    )
    search, ground = _Search(scene, (models, loss, compute.device, compute.jobs), advance), PlaceFinder(scene)
    trials = search.screened(ground.spots(PLACES))
    leaders = sorted(trials, key=lambda trial: trial.outlook)[:TURNED]
    trials += search.screened([turn for leader in leaders for turn in ground.turned(leader.spot)])
    trials.sort(key=lambda trial: trial.outlook)
    finalists = _finalists(trials, min(ground.size_mm))
    drafts = search.drafted(finalists)
    order = sorted(range(len(finalists)), key=lambda i: float(drafts[i].mean()))
    candidates = [_candidate(finalists[i], float(drafts[i].mean())) for i in order]
    candidates += [_candidate(trial) for trial in trials if trial not in finalists]
    advance(search.passes, search.passes)  # no more will come
    return Place(
        sheet_id=scene.sheet_id,
        front=scene.settings.patch.side,
        at=candidates[0].at,
        spin_deg=candidates[0].spin_deg,
        lead=_lead(drafts[order[1]] - drafts[order[0]]) if len(order) > 1 else None,
        passes=search.passes,
        run_share=search.passes / default_run_passes(),
        candidates=tuple(candidates),
    )


def place_lines(place: Place) -> list[str]:
    """The choice for the terminal: the place as a scene file would say it, how sure it is, and what it cost."""
    at = f'side = "{place.at}"' if isinstance(place.at, str) else f"at_mm = [{', '.join(f'{v:g}' for v in place.at)}]"
    where = f'{at}, spin_deg = {place.spin_deg:g}, view.front = "{place.front}"'
    drafted = sum(candidate.draft is not None for candidate in place.candidates)
    cost = f"{len(place.candidates)} tried, {drafted} drafted, {place.run_share:.0%} of a default run's passes"
    if place.lead is None:
        return [f"chosen: {where}", f"the only place; {cost}"]
    low, high = place.lead.interval
    sure = "surely" if place.lead.sure else "not surely"
    lead = f"{sure} better than the next: loss lower by {place.lead.value:.2f} [{low:.2f}, {high:.2f}]"
    return [f"chosen: {where}", f"{lead}; {cost}"]


def default_run_passes() -> int:
    """A network's passes in a default run: all its views, those of training once more, and a short promise's."""
    settings = OptimizeSettings()
    return views_per_network(settings) + settings.steps * settings.views + min_promise_passes()


class _Search:
    """A search under way, which counts its networks' passes."""

    def __init__(self, scene: UnplacedScene, stated, advance: Advance):
        self.passes, self._scene, self._stated, self._advance = 0, scene, stated, advance
        self._first: Problem | None = None
        self._bare: float | None = None

    def screened(self, spots: Sequence[CandidatePlace]) -> list[_ScreenedPlace]:
        """The spots where the piece can hang, with what gray costs there and its gradient promises."""
        conditions, hung = self._scene.draw("train", SCREEN_VIEWS), self._hung(spots)
        if self._bare is None and hung:
            self._bare = float(self._losses(hung[0][1], None, conditions).mean())
        screens = self._shared(partial(_screen, conditions), [problem for _, problem in hung], 2 * len(conditions))
        bare = self._bare or 0.0
        return [
            _ScreenedPlace(spot, problem, loss - bare, loss - bare - reach)
            for (spot, problem), (loss, reach) in zip(hung, screens, strict=True)
        ]

    def drafted(self, trials: Sequence[_ScreenedPlace]) -> list[np.ndarray]:
        """N losses of a draft at each place in the held-out views, less the bare object's there; the drafts take as
        many steps as the budget has left.
        """
        held_out = self._scene.draw("select", HELD_OUT_VIEWS)
        left = PASSES - self.passes - (len(trials) + 1) * HELD_OUT_VIEWS
        steps = max(1, left // (len(trials) * 2 * DRAFT_VIEWS))
        conditions = self._scene.draw("train", steps * DRAFT_VIEWS, start=SCREEN_VIEWS)
        bare = self._losses(trials[0].problem, None, held_out)
        problems = [trial.problem for trial in trials]
        drafts = self._shared(partial(_drafted, conditions, held_out), problems, 2 * len(conditions) + len(held_out))
        return [losses - bare for losses in drafts]

    def _hung(self, spots: Sequence[CandidatePlace]) -> list[tuple[CandidatePlace, Problem]]:
        """The spots' problems; where the piece can hang at none of them, the last refusal is the user's."""
        hung, refusal = [], None
        for spot in spots:
            try:
                scene = self._scene.at(spot.at, spot.spin_deg)
            except Refused as refused:
                refusal = refused
                continue
            if self._first is None:
                models, loss, device, jobs = self._stated
                self._first = set_problem(scene, device, models, loss, jobs)
            hung.append((spot, self._first.hung(scene)))
        if refusal is not None and self._first is None:
            raise refusal
        return hung

    def _shared(self, look: Callable[[Problem], Any], problems: Sequence[Problem], passes: int) -> list[Any]:
        """What a look at each problem says, of so many passes; the processes share the problems."""
        before, jobs = self.passes, min(len(problems), self._stated[-1])
        with fork_workers(lambda number: look(problems[number]), max(1, jobs)) as (workers, share):
            looks = range(len(problems))
            return workers.map(share, looks, lambda done, _: self._count(before + done * passes - self.passes))

    def _losses(self, problem: Problem, shown: Appearance, conditions: Conditions) -> np.ndarray:
        self._count(len(conditions))
        return _losses(problem, shown, conditions)

    def _count(self, passes: int) -> None:
        self.passes += passes
        self._advance(self.passes, PASSES)


def _screen(conditions: Conditions, problem: Problem) -> tuple[float, float]:
    """The loss of gray, and the decrease that its gradient promises."""
    answer = gradient_in_views(problem, start(problem).design, [training_views(problem, conditions)])
    coarse = problem.subject.levels(answer.gradient)[-1]
    return answer.loss, _REACH * float(coarse.abs().sum()) * answer.gradient.numel() / coarse.numel()


def _drafted(conditions: Conditions, held_out: Conditions, problem: Problem) -> np.ndarray:
    """N losses of a draft in the held-out views."""
    design = draft(problem, conditions, DRAFT_VIEWS)
    return _losses(problem, problem.subject.shown(from_pixels(as_pixels(design), problem.device)), held_out)


def _losses(problem: Problem, shown: Appearance, conditions: Conditions) -> np.ndarray:
    """N losses, means over the networks."""
    return responses(problem, {"": shown}, conditions, problem.training_px)[""].loss.mean(0)


def _finalists(trials: Sequence[_ScreenedPlace], edge_mm: float) -> list[_ScreenedPlace]:
    """The best, a whole piece apart: screening may be wrong about a part of the object. Only where that gives too few,
    as near to each other as places are.
    """
    far, near = _apart(trials, edge_mm), _apart(trials, MIN_DISTANCE_SHARE * edge_mm)
    return [*far, *(trial for trial in near if trial not in far)][:DRAFTS]


def _apart(trials: Sequence[_ScreenedPlace], apart_mm: float) -> list[_ScreenedPlace]:
    """The trials without those next to a better one on the same side: a place counts once, at its best spin."""
    kept: list[_ScreenedPlace] = []
    for trial in trials:
        laid, others = trial.spot.placement, [other.spot.placement for other in kept]
        near = [np.linalg.norm(laid.center_mm - other.center_mm) < apart_mm for other in others]
        alike = [laid.normal @ other.normal > 0.5 for other in others]
        if not np.logical_and(near, alike).any():
            kept.append(trial)
    return kept


def _lead(differences: np.ndarray) -> Lead:
    mean = student_mean(differences)
    return Lead(value=mean.value, interval=(mean.low, mean.high), sure=mean.low > 0)


def _candidate(trial: _ScreenedPlace, draft_loss: float | None = None) -> Candidate:
    laid = trial.spot.placement
    return Candidate(
        at=trial.spot.at,
        spin_deg=trial.spot.spin_deg,
        family=laid.family,
        gap_mm=round(laid.gap_mm, 2),
        overhang_share=round(laid.overhang_share, 4),
        gray=trial.gray,
        outlook=trial.outlook,
        draft=draft_loss,
    )
