"""Perception by gradient descent on the free energy (equation 3)."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from services.estimator.paper.free_energy import Gradient, gradient
from services.estimator.shared.asking import Conversation, alone

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.paper.decoder import GenerativeModel
    from services.estimator.shared.asking import Pieces

Mask = npt.NDArray[np.bool_]
State = Literal["localising", "tracking", "lost"]


@dataclass(frozen=True)
class Descent:
    """The paper's parameters. Sigma_o = 1 m² on every beam, as there."""

    alpha: float = 2e-3  # m², step size along the map's longest axis; twice that and the belief swings near walls
    beta: float = 0.0  # weight of the goal's attraction in perception; 0 leaves the goal to the controller
    iterations: int = 10  # gradient steps a scan; the paper makes 1, but its robot stands between two steps
    max_step: float = 0.5  # m, a longer step of one scan is shortened
    settled_step: float = 0.03  # m, mean step below which the belief counts as settled
    settled_misfit: float = 2.0  # times the model's own error on test scans
    window: int = 10  # scans over which step and misfit are averaged


@dataclass(frozen=True)
class Estimate:
    """What one scan made of the belief."""

    pose: Array  # (3,) base_link in map
    predicted: Array  # (B,) m, g at the pose
    gradient: Gradient
    state: State


@dataclass(frozen=True)
class Decode:
    """The question preset `paper` asks (see `asking`): what is expected at a pose, and its derivative."""

    model: GenerativeModel
    pose: Array  # (3,)
    beams: int = 0

    @property
    def alike(self) -> Hashable:
        """One network."""
        return id(self.model)

    def answer(self) -> tuple[Array, Array]:
        """Now."""
        return self.model.predict(self.pose)

    def answer_all(self, questions: Sequence[Decode]) -> list[tuple[Array, Array]]:
        """All poses through the network at once."""
        ranges, jacobians = self.model.predict_all(np.array([question.pose for question in questions]))
        return list(zip(ranges, jacobians, strict=True))

    def in_pieces(self, beams: int) -> Pieces[tuple[Array, Array]]:  # noqa: ARG002
        """There is but one."""
        yield from ()
        return self.answer()


@dataclass
class PaperEstimator:
    """Belief about (x, y); the heading is known and frozen, there is no covariance and no prior in time."""

    model: GenerativeModel
    model_error: float  # m, mean absolute error of the model's beams on test scans
    bounds: tuple[float, float, float, float]  # m, the belief stays within x0, y0, x1, y1
    pose: Array  # (3,) initial belief
    settings: Descent = field(default_factory=Descent)
    metric: Array = field(default_factory=lambda: np.ones(2))  # (2,) of alpha by axis, see Normalisation.metric
    known: bool = False  # the initial belief is where the robot is, so it tracks from the first scan on

    def __post_init__(self) -> None:
        """Nothing is known of the first steps."""
        self._steps: list[float] = []
        self._misfits: list[float] = []
        self._was_tracking = self.known

    def restart(self, pose: Array, *, known: bool = False) -> None:
        """Believe ``pose`` (3,): told that it is there, or to localise from there."""
        self.pose, self.known = np.array(pose, float), known
        self.__post_init__()

    def update(self, ranges: Array, goal: Array | None = None, says: Mask | None = None) -> Estimate:
        """Descend F for a scan of usable ranges (B,) m; ``goal`` (3,) attracts the belief where beta > 0.

        Beams that are not among ``says`` (B,) say nothing: F is that of the others.
        """
        return alone(self.updating(ranges, goal, says))

    def updating(self, ranges: Array, goal: Array | None = None, says: Mask | None = None) -> Conversation[Estimate]:
        """The same as a conversation: see `asking`."""
        used = slice(None) if says is None or says.all() else says
        ranges = ranges[used]
        precision = np.ones(len(ranges))
        before = self.pose
        metric = np.append(self.metric, 1.0)
        g_goal = None
        if goal is not None and self.settings.beta > 0:
            g_goal, _ = yield Decode(self.model, goal)
            g_goal = g_goal[used]
        for _ in range(self.settings.iterations):
            g, dg = yield Decode(self.model, self.pose)
            found = gradient(ranges, g[used], dg[used], precision, g_goal, self.settings.beta)
            step = self.settings.alpha * metric * found.descent
            length = float(np.hypot(step[0], step[1]))
            self.pose = self._inside(self.pose + step * min(1.0, self.settings.max_step / max(length, 1e-12)))
        g, dg = yield Decode(self.model, self.pose)
        final = gradient(ranges, g[used], dg[used], precision, g_goal, self.settings.beta)
        # A scan that says nothing fits no worse, and no better, than the one before.
        misfit = float(np.mean(np.abs(ranges - g[used]))) if len(ranges) else (self._misfits or [np.inf])[-1]
        state = self._judge(float(np.hypot(*(self.pose - before)[:2])), misfit)
        return Estimate(self.pose.copy(), g, final, state)

    def _inside(self, pose: Array) -> Array:
        x0, y0, x1, y1 = self.bounds
        return np.array([np.clip(pose[0], x0, x1), np.clip(pose[1], y0, y1), pose[2]])

    def _judge(self, step: float, misfit: float) -> State:
        """Tracking once steps are short and the scan fits as well as the model can; lost when it no longer does."""
        window = self.settings.window
        self._steps = [*self._steps, step][-window:]
        self._misfits = [*self._misfits, misfit][-window:]
        fits = float(np.mean(self._misfits)) < self.settings.settled_misfit * self.model_error
        settled = len(self._steps) == window and float(np.mean(self._steps)) < self.settings.settled_step
        if self._was_tracking:
            # Twice the misfit that was needed to begin: no flicker at the border.
            self._was_tracking = float(np.mean(self._misfits)) < 2 * self.settings.settled_misfit * self.model_error
            return "tracking" if self._was_tracking else "lost"
        self._was_tracking = settled and fits
        return "tracking" if self._was_tracking else "localising"
