"""Images that would spoil a reconstruction: blank, overexposed, blurred, of another scene or another state of it, given
twice, or with a camera that does not fit them.

Of the chosen views, each is compared with its nearest one, as the depth range is found, so that the matches are used
twice. Only where that fails are others compared, to tell which of the two is at fault: a view that fits no other is, if
those that it fails with fit others. Views of another state of the scene fit all the same; `contradictions` tells them.
"""

import logging
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import islice

import numpy as np

from ..errors import InputError
from ..geometry.baselines import coinciding_poses, have_baseline, nearest_neighbor_pairs, pairwise_baselines
from .contradictions import MIN_SPREAD, Contradiction, find_contradictions
from .image_quality import (
    ImageStatistics,
    describe_blank,
    describe_blurred,
    describe_overexposed,
    maybe_defective,
    measure,
)
from .loader import ViewLoader
from .pair_fit import PairFit, Verdict, fit_pair
from .selection import MIN_VIEWS, PairScorer, PairwiseScores, guess_scene_depths

LOG = logging.getLogger(__name__)

NEIGHBOURS = 4  # that an image is compared with where it is in doubt
# Of neighbours, by their cameras.
MIN_OVERLAP, MIN_PARALLAX_DEG, MAX_PARALLAX_DEG = 0.3, 0.1, 25.0
# Of a pair of which common points are expected; beyond these limits good pairs may have none.
MIN_SURE_OVERLAP, MAX_SURE_PARALLAX_DEG = 0.6, 15.0

SAME_IMAGE, SAME_POSE = "is the same image", "has the same pose"


@dataclass(frozen=True)
class Defect:
    """index: of the image. what: is wrong with it, for the user. soft: whether it can still be used.

    contradicts: whether the image shows another state of the scene.
    """

    index: int
    what: str
    soft: bool = False
    contradicts: bool = False


def find_defects(loader: ViewLoader, chosen: Sequence[int], usable: Sequence[int], cameras: bool) -> list[Defect]:
    """What is wrong with the chosen images, one defect for each that has any.

    loader: one that makes feature images. chosen, usable: indices of the loader's pairs, sorted; the usable ones are
    those to compare the chosen ones with. cameras: whether the images may not fit their cameras.
    Raises InputError if no two images fit their cameras, or if a chosen image cannot be read.
    """
    checker = _Checker(loader, usable)
    defects = checker.blank(chosen) or checker.poor(chosen)  # what these show is no use for comparisons
    if all(defect.soft for defect in defects):
        blurred = {defect.index for defect in defects}
        sharp = [index for index in chosen if index not in blurred]
        misfits = checker.misfits(sharp) if cameras else []
        defects += misfits or checker.contradictions(sharp)
    for defect in defects:
        LOG.info("%s", defect.what)
    return defects


class _Checker:
    """Compares images; statistics, neighbours and fits are computed when first needed."""

    def __init__(self, loader: ViewLoader, usable: Sequence[int]) -> None:
        self.loader, self.usable = loader, usable
        self._statistics: dict[int, ImageStatistics] = {}
        self._fits: dict[tuple[int, int], PairFit] = {}

    def blank(self, chosen: Sequence[int]) -> list[Defect]:
        """Images that show nothing."""
        found = [(index, describe_blank(self._measured(index))) for index in chosen]
        return [self._defect(index, what) for index, what in found if what]

    def poor(self, chosen: Sequence[int]) -> list[Defect]:
        """Overexposed and blurred images, compared with those around them."""
        distances = pairwise_baselines(self._extrinsics(chosen))
        np.fill_diagonal(distances, np.inf)
        found = []
        for index, nearest in zip(chosen, distances.argmin(axis=1).tolist(), strict=True):
            image = self._measured(index)
            if maybe_defective(image, self._measured(chosen[nearest])):
                around = [self._measured(other) for other in self._neighbours(index)]
                if around and (what := describe_overexposed(image, around)):
                    found.append(self._defect(index, what))
                elif around and (what := describe_blurred(image, around)):
                    found.append(self._defect(index, what, soft=True))
        return found

    def misfits(self, chosen: Sequence[int]) -> list[Defect]:
        """Images that do not fit their cameras, while others do, and ones given twice.

        Raises InputError if none fit.
        """
        poses = self._extrinsics(chosen)
        if len(chosen) < MIN_VIEWS or not have_baseline(poses):
            return []
        twins = self._twins(chosen, poses)
        pairs = {(chosen[i], chosen[j]) for i, j in nearest_neighbor_pairs(poses)} - set(twins)
        twins |= {pair: SAME_IMAGE for pair in pairs if self._fit(*pair).verdict is Verdict.IDENTICAL}
        suspects = sorted({index for pair in (*twins, *filter(self._fails, pairs)) for index in pair})
        for index in suspects:
            pairs |= {(min(index, other), max(index, other)) for other in self._neighbours(index)} - set(twins)
        at_fault = self._at_fault(suspects, sorted(pairs)) if suspects else {}
        found = [self._defect(index, self._describe(index, *pair)) for index, pair in at_fault.items()]
        for (first, second), what in twins.items():
            if not {first, second} & set(at_fault):
                found.append(self._defect(second, f"{what} as {self.loader.name(first)}, expected another"))
        return found

    def contradictions(self, chosen: Sequence[int]) -> list[Defect]:
        """Images of another state of the scene than most of the chosen ones."""
        if len(chosen) <= MIN_VIEWS or not have_baseline(self._extrinsics(chosen)):
            return []
        place = {index: place for place, index in enumerate(chosen)}
        parallax: dict[tuple[int, int], float] = {}
        for index in chosen:
            for other, angle in islice(self._overlapping(index, chosen).items(), NEIGHBOURS):
                parallax[place[min(index, other)], place[max(index, other)]] = angle
        found = find_contradictions([self.loader.feature_image(index).whole for index in chosen], parallax)
        names = [self.loader.name(index) for index in chosen]
        return [
            Defect(chosen[view], f"{names[view]}: {_describe_state(view, shown, names)}", contradicts=True)
            for view, shown in found.items()
        ]

    def _twins(self, chosen: Sequence[int], poses: np.ndarray) -> dict[tuple[int, int], str]:
        """Pairs of the same image or the same pose, and what is the same."""
        twins = {(chosen[i], chosen[j]): SAME_POSE for i, j in coinciding_poses(poses)}
        first_of: dict[bytes, int] = {}
        for index in chosen:
            first = first_of.setdefault(self.loader.load(index).image.tobytes(), index)
            if first != index:
                twins[first, index] = SAME_IMAGE
        return twins

    def _at_fault(self, suspects: Sequence[int], pairs: Sequence[tuple[int, int]]) -> dict[int, tuple[int, int]]:
        """The suspects that are at fault, each with a pair that shows it.

        An image is confirmed if it fits another one. One that is not is at fault if it fails with any; one that is, if
        it fails with more confirmed images than it fits.
        Raises InputError if no image is confirmed.
        """
        fitting = [pair for pair in pairs if self._fit(*pair).verdict is Verdict.FITS]
        failing = [pair for pair in pairs if self._fails(pair)]
        confirmed = {index for pair in fitting for index in pair}
        if failing and not confirmed:
            first, second = (self.loader.name(index) for index in failing[0])
            raise InputError(
                f"{first} and {second}: do not fit their cameras: {self._fit(*failing[0]).describe('between them')}; "
                "check that the cameras are those of these images"
            )
        at_fault = {}
        for index in suspects:
            against = [pair for pair in failing if index in pair]
            if index in confirmed:
                against = [pair for pair in against if confirmed.issuperset(pair)]
            if len(against) > sum(index in pair for pair in fitting):
                at_fault[index] = max(against, key=lambda pair: self._fit(*pair).matches)
        return at_fault

    def _describe(self, index: int, first: int, second: int) -> str:
        fit, other = self._fit(first, second), self.loader.name(second if index == first else first)
        what = (
            "does not fit its camera" if fit.verdict is Verdict.CONTRADICTS else "shows another scene than its camera"
        )
        return f"{what}: {fit.describe(f'with {other}')}"

    # ---- computed when first needed

    def _measured(self, index: int) -> ImageStatistics:
        if index not in self._statistics:
            self._statistics[index] = measure(self.loader.load(index).image)
        return self._statistics[index]

    def _fails(self, pair: tuple[int, int]) -> bool:
        return self._fit(*pair).fails

    def _fit(self, first: int, second: int) -> PairFit:
        """How two images fit their cameras; of smaller copies at first, if the larger ones have no other use."""
        if (first, second) not in self._fits:
            images = self.loader.feature_image(first), self.loader.feature_image(second)
            fit = PairFit(Verdict.UNKNOWN)
            if not self.loader.needs_depth:
                fit = fit_pair(images[0].reduced, images[1].reduced)
            if fit.verdict is not Verdict.FITS:
                fit = fit_pair(*images)
            if fit.verdict is Verdict.UNRELATED and not self._surely_overlap(first, second):
                fit = PairFit(Verdict.UNKNOWN)
            self._fits[first, second] = fit
        return self._fits[first, second]

    def _neighbours(self, index: int) -> list[int]:
        """The usable images that overlap best with one, by their cameras, without unreadable and blank ones."""
        found = []
        for other in self._overlapping(index, self.usable):
            with suppress(InputError):  # one that is not chosen is no reason to stop
                if describe_blank(self._measured(other)) is None:
                    found.append(other)
            if len(found) == NEIGHBOURS:
                break
        return found

    def _overlapping(self, index: int, others: Sequence[int]) -> dict[int, float]:
        """Of other images, those that overlap with one by their cameras, with their parallax, lowest cost first."""
        scores = self._scores(index, others)
        suitable = (scores.overlap >= MIN_OVERLAP) & (scores.parallax <= MAX_PARALLAX_DEG)
        suitable &= scores.parallax >= MIN_PARALLAX_DEG
        order = np.argsort(scores.cost, kind="stable")
        return {others[other]: float(scores.parallax[other]) for other in order.tolist() if suitable[other]}

    def _surely_overlap(self, first: int, second: int) -> bool:
        scores = self._scores(first, [second])
        return bool(scores.overlap[0] >= MIN_SURE_OVERLAP and scores.parallax[0] <= MAX_SURE_PARALLAX_DEG)

    def _scores(self, index: int, others: Sequence[int]) -> PairwiseScores:
        """Scores of one image with others, [others]."""
        position_of = {usable: position for position, usable in enumerate(self.usable)}
        positions = np.array([position_of[other] for other in others])
        return self._scorer.score(np.full(len(others), position_of[index]), positions)

    @cached_property
    def _scorer(self) -> PairScorer:
        cameras = [self.loader.pairs[index][1] for index in self.usable]
        return PairScorer(cameras, guess_scene_depths(cameras))

    def _extrinsics(self, chosen: Sequence[int]) -> np.ndarray:
        """Poses of images, [images, 4, 4]."""
        return np.array([self.loader.pairs[index][1].extrinsics for index in chosen])

    def _defect(self, index: int, what: str, soft: bool = False) -> Defect:
        return Defect(index, f"{self.loader.name(index)}: {what}", soft)


def _describe_state(view: int, shown: Contradiction, names: Sequence[str]) -> str:
    """What is wrong with a view of another state of the scene. names: of the views."""
    other = names[shown.other]
    if view != shown.view:
        return f"shows the scene as {names[shown.view]}, which contradicts {other}"
    return (
        f"contradicts {other}: their common points cover {100 * shown.spread:.0f} % of the area expected, "
        f"{100 * MIN_SPREAD:.0f} % at least; part of the scene was moved between them"
    )
