"""`place = "auto"`: find where on the object a design is most effective, for less than a quarter of a run's cost.

In: an `UnplacedScene` and its networks. Out: `Place`. Places all over the surface (see `scene.candidate_places`) are
compared in the same views, those of `patch.side`, in three stages. Screening: the loss of a gray design at each place,
and the decrease that its gradient predicts. Turns: the same for other spins at the few best places. Drafts: the best
get a few steps of the real loop, and held-out views decide. Screening and drafts use draws of the train stream, the
decision those of the select stream; the promise's are never used. A scene and seed always give the same place.

Left out on purpose: whether the runner-up would win with more steps or another seed. The interval covers the views
alone, and it is slightly optimistic, since the best of a few is selected.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from pydantic import Field

from patchproof.base.errors import Refused
from patchproof.base.intervals import Estimate, student_mean
from patchproof.base.progress import Advance, Compute, Progress, no_progress
from patchproof.base.validation import Side, StrictModel
from patchproof.base.workers import fork_workers
from patchproof.classifier.network import Classifier
from patchproof.optimizer.expectation import gradient_in_views, training_views
from patchproof.optimizer.loop import draft, start
from patchproof.optimizer.problem import Problem, set_problem
from patchproof.optimizer.responses import responses
from patchproof.optimizer.subject import Loss, as_pixels, from_pixels
from patchproof.render.pixels import Appearance
from patchproof.scene.candidate_places import MIN_DISTANCE_SHARE, CandidatePlace, PlaceFinder
from patchproof.scene.conditions import Conditions
from patchproof.scene.interface import Scene
from patchproof.scene.patch_scene import PiecePosition, UnplacedScene, require_unplaced

MAX_PASSES = 608  # pictures that go through a network; pictures with a gradient count twice
SCREENED_PLACES, SCREEN_VIEWS = 24, 4  # 192 passes, and 4 for the bare object
TURNED_PLACES = 4  # the best places, with at most three turns each: 96 passes
# Drafts take the remaining passes, 18 steps at least. With as many views, 18 steps of 2 lowered the loss by 0.02 to
# 0.03 more than 9 steps of 4 (two places on the demo's truck).
DRAFTED_PLACES, DRAFT_VIEWS, HELD_OUT_VIEWS = 3, 2, 24
_TRUST_RANGE = 0.1  # of sRGB's range: the change up to which a gradient is trusted


class Candidate(StrictModel):
    """A place that was tried. From each loss the bare object's in the same views is subtracted: lower is better for the
    goal. `outlook` is `gray` minus the predicted decrease, `draft` the loss of a drafted design in held-out views.
    """

    at: PiecePosition
    spin_deg: float
    gray: float
    outlook: float
    draft: float | None = None


class Place(StrictModel):
    """The chosen place, in the form of the keys `patch.at_mm` (or `patch.side`), `patch.spin_deg` and `view.front`.
    Candidates run from the best to the worst. `lead` is the difference of the runner-up's loss and the chosen draft's
    in the same held-out views, `passes` counts one network's passes.
    """

    sheet_id: str  # of the scene that was searched
    inputs: dict[str, str] = Field(default_factory=dict)  # fingerprints of its files and networks
    front: Side
    at: PiecePosition
    spin_deg: float
    lead: Estimate | None  # None if no other place was drafted
    passes: int
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True, eq=False)
class _ScreenedPlace:
    """A candidate place, the problem with the piece there, and its screening losses."""

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
        scene: loaded by `load_scene` or `make_scene`; `scene.with_piece_at(place.at, place.spin_deg)` places it.
        models, loss: networks and loss in place of the scene's, as in `optimize`.
        compute: device and processes; refuses a cluster.
        progress: called with the stage "place" (passes of the networks).

    Raises:
        Refused: where the piece fits nowhere on the object.
    """
    scene, compute = require_unplaced(scene), compute.without("choose_place", cluster=True)
    advance = partial(progress, "place")
    search, finder = _Search(scene, (models, loss, compute.device, compute.jobs), advance), PlaceFinder(scene)
    trials = search.screen(finder.candidates(SCREENED_PLACES))
    leaders = sorted(trials, key=lambda trial: trial.outlook)[:TURNED_PLACES]
    trials += search.screen([turn for leader in leaders for turn in finder.other_spins(leader.spot)])
    trials.sort(key=lambda trial: trial.outlook)
    finalists = _finalists(trials, min(finder.size_mm))
    drafts = search.draft_at(finalists)
    ranking = sorted(range(len(finalists)), key=lambda i: float(drafts[i].mean()))
    candidates = [_candidate(finalists[i], float(drafts[i].mean())) for i in ranking]
    candidates += [_candidate(trial) for trial in trials if trial not in finalists]
    advance(search.passes, search.passes)  # the search may stop short of MAX_PASSES
    return Place(
        sheet_id=scene.sheet_id,
        inputs=finalists[0].problem.inputs,
        front=scene.settings.patch.side,
        at=candidates[0].at,
        spin_deg=candidates[0].spin_deg,
        lead=student_mean(drafts[ranking[1]] - drafts[ranking[0]]) if len(ranking) > 1 else None,
        passes=search.passes,
        candidates=tuple(candidates),
    )


def place_lines(place: Place) -> list[str]:
    """Lines for the terminal: the place as a scene file writes it, how sure the choice is, and its cost."""
    at = f'side = "{place.at}"' if isinstance(place.at, str) else f"at_mm = [{', '.join(f'{v:g}' for v in place.at)}]"
    where = f'{at}, spin_deg = {place.spin_deg:g}, view.front = "{place.front}"'
    draft_count = sum(candidate.draft is not None for candidate in place.candidates)
    cost = f"{len(place.candidates)} tried, {draft_count} drafted, in {place.passes} passes of a network"
    if place.lead is None:
        return [f"chosen: {where}", f"the only place; {cost}"]
    lead, sure = place.lead, "surely" if place.lead.low > 0 else "not surely"
    better = f"{sure} better than the next: loss lower by {lead.value:.2f} [{lead.low:.2f}, {lead.high:.2f}]"
    return [f"chosen: {where}", f"{better}; {cost}"]


class _Search:
    """A search in progress; counts its networks' passes."""

    def __init__(self, scene: UnplacedScene, options, advance: Advance):
        self.passes, self._scene, self._options, self._advance = 0, scene, options, advance
        self._first: Problem | None = None
        self._bare: float | None = None

    def screen(self, spots: Sequence[CandidatePlace]) -> list[_ScreenedPlace]:
        """Screen the places where the piece fits: the loss of gray, and the decrease that its gradient predicts."""
        conditions, problems = self._scene.draw("train", SCREEN_VIEWS), self._problems_at(spots)
        if self._bare is None and problems:
            self._bare = float(self._losses(problems[0][1], None, conditions).mean())
        screens = self._map(partial(_screen, conditions), [problem for _, problem in problems], 2 * len(conditions))
        bare = self._bare or 0.0
        return [
            _ScreenedPlace(spot, problem, loss - bare, loss - bare - decrease)
            for (spot, problem), (loss, decrease) in zip(problems, screens, strict=True)
        ]

    def draft_at(self, trials: Sequence[_ScreenedPlace]) -> list[np.ndarray]:
        """N losses of drafts of as many steps as the budget allows, in the held-out views, minus the bare object's."""
        held_out = self._scene.draw("select", HELD_OUT_VIEWS)
        remaining = MAX_PASSES - self.passes - (len(trials) + 1) * HELD_OUT_VIEWS
        steps = max(1, remaining // (len(trials) * 2 * DRAFT_VIEWS))
        conditions = self._scene.draw("train", steps * DRAFT_VIEWS, start=SCREEN_VIEWS)
        bare = self._losses(trials[0].problem, None, held_out)
        problems = [trial.problem for trial in trials]
        drafts = self._map(partial(_draft_losses, conditions, held_out), problems, 2 * len(conditions) + len(held_out))
        return [losses - bare for losses in drafts]

    def _problems_at(self, spots: Sequence[CandidatePlace]) -> list[tuple[CandidatePlace, Problem]]:
        """The places' problems; where the piece fits at none of them, the last refusal is raised."""
        problems, refusal = [], None
        for spot in spots:
            try:
                scene = self._scene.with_piece_at(spot.at, spot.spin_deg)
            except Refused as refused:
                refusal = refused
                continue
            if self._first is None:
                models, loss, device, jobs = self._options
                self._first = set_problem(scene, device, models, loss, jobs)
            problems.append((spot, self._first.with_piece_at(scene)))
        if refusal is not None and self._first is None:
            raise refusal
        return problems

    def _map(self, look: Callable[[Problem], Any], problems: Sequence[Problem], passes: int) -> list[Any]:
        """Call `look` with each problem, in parallel, and count `passes` for each."""
        passes_before, jobs = self.passes, min(len(problems), self._options[-1])
        with fork_workers(lambda number: look(problems[number]), max(1, jobs)) as (workers, share):
            looks = range(len(problems))
            return workers.map(share, looks, lambda done, _: self._count(passes_before + done * passes - self.passes))

    def _losses(self, problem: Problem, appearance: Appearance, conditions: Conditions) -> np.ndarray:
        self._count(len(conditions))
        return _losses(problem, appearance, conditions)

    def _count(self, passes: int) -> None:
        self.passes += passes
        self._advance(self.passes, MAX_PASSES)


def _screen(conditions: Conditions, problem: Problem) -> tuple[float, float]:
    """The loss of gray, and the decrease that its gradient predicts."""
    answer = gradient_in_views(problem, start(problem).design, [training_views(problem, conditions)])
    coarsest = problem.subject.gradient_levels(answer.gradient)[-1]
    return answer.loss, _TRUST_RANGE * float(coarsest.abs().sum()) * answer.gradient.numel() / coarsest.numel()


def _draft_losses(conditions: Conditions, held_out: Conditions, problem: Problem) -> np.ndarray:
    """N losses of a draft in the held-out views."""
    design = draft(problem, conditions, DRAFT_VIEWS)
    return _losses(problem, problem.subject.appearance(from_pixels(as_pixels(design), problem.device)), held_out)


def _losses(problem: Problem, appearance: Appearance, conditions: Conditions) -> np.ndarray:
    """N losses in these views, means over the networks."""
    return responses(problem, {"": appearance}, conditions, problem.training_px)[""].loss.mean(0)


def _finalists(trials: Sequence[_ScreenedPlace], edge_mm: float) -> list[_ScreenedPlace]:
    """The best places, at least a whole piece from each other, since screening may be wrong about a part of the object;
    where these are too few, closer ones are added.
    """
    far_apart, close = _thin_out(trials, edge_mm), _thin_out(trials, MIN_DISTANCE_SHARE * edge_mm)
    return [*far_apart, *(trial for trial in close if trial not in far_apart)][:DRAFTED_PLACES]


def _thin_out(trials: Sequence[_ScreenedPlace], distance_mm: float) -> list[_ScreenedPlace]:
    """Drop places near a better one on the same side, so that a place counts once, at its best spin."""
    remaining: list[_ScreenedPlace] = []
    for trial in trials:
        placement, others = trial.spot.placement, [other.spot.placement for other in remaining]
        is_near = [np.linalg.norm(placement.center_mm - other.center_mm) < distance_mm for other in others]
        same_side = [placement.normal @ other.normal > 0.5 for other in others]
        if not np.logical_and(is_near, same_side).any():
            remaining.append(trial)
    return remaining


def _candidate(trial: _ScreenedPlace, draft_loss: float | None = None) -> Candidate:
    spot = trial.spot
    return Candidate(at=spot.at, spin_deg=spot.spin_deg, gray=trial.gray, outlook=trial.outlook, draft=draft_loss)
