"""Perception by gradient descent on the free energy (equation 3)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt

from services.estimator.paper.free_energy import FreeEnergy

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.paper.decoder import ScanPredictor

Mask = npt.NDArray[np.bool_]
State = Literal["localising", "tracking", "lost"]


@dataclass(frozen=True)
class Descent:
    """The paper's parameters. Sigma_o, which it does not state, is 1 m² for each beam: only alpha / Sigma_o matters."""

    # m², step size along the map's longest axis; with twice the value the belief oscillates near walls
    alpha: float = 2e-3
    beta: float = 0.0  # weight of the goal's attraction in perception; with 0 only the controller uses the goal
    iterations: int = 10  # gradient steps per scan; the paper makes 1, but its robot stands still between two steps
    max_step: float = 0.5  # m, limit of the length of a step
    settled_step: float = 0.03  # m, mean step below which the belief counts as settled
    settled_misfit: float = 2.0  # relative to the model's error on test scans, below which the scan fits
    window: int = 10  # scans over which step and misfit are averaged


@dataclass(frozen=True)
class PaperEstimate:
    """The belief after one scan."""

    pose: Array  # (3,) base_link in map
    predicted: Array  # (B,) m, g at the pose
    free_energy: FreeEnergy
    state: State


@dataclass
class PaperPerception:
    """Belief about (x, y), with a known constant heading, without covariance and without a motion model."""

    model: ScanPredictor
    model_error: float  # m, mean absolute error of the model's beams on test scans
    bounds: tuple[float, float, float, float]  # m, x0, y0, x1, y1 of the map, within which the belief stays
    pose: Array  # (3,) initial belief
    settings: Descent = field(default_factory=Descent)
    # (2,) factor on alpha for each axis, see Normalisation.metric
    metric: Array = field(default_factory=lambda: np.ones(2))
    known: bool = False  # the initial belief is the true pose, so the state is tracking from the first scan

    def __post_init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        """Clears the averages of step and misfit."""
        self._steps: list[float] = []
        self._misfits: list[float] = []
        self._was_tracking = self.known
        self._prediction: tuple[Array, Array] | None = None  # g and dg at the belief

    def restart(self, pose: Array, *, known: bool = False) -> None:
        """Starts at ``pose`` (3,), which is the true pose if ``known``, else only a start for localisation."""
        self.pose, self.known = np.array(pose, float), known
        self._clear()

    def update(self, ranges: Array, goal: Array | None = None, measured: Mask | None = None) -> PaperEstimate:
        """Descends F for a scan of usable ranges (B,) m; ``goal`` (3,) attracts the belief if beta > 0.

        ``measured`` (B,) is a mask of the beams to use; defaults to all.
        """
        used = slice(None) if measured is None or measured.all() else measured
        ranges = ranges[used]
        precision = np.ones(len(ranges))
        previous = self.pose
        metric = np.append(self.metric, 1.0)
        g_goal = None
        if goal is not None and self.settings.beta > 0:
            g_goal = self.model.predict(goal)[0][used]
        g, dg = self._prediction or self.model.predict(self.pose)
        for _ in range(self.settings.iterations):
            free_energy = FreeEnergy(ranges, g[used], dg[used], precision, g_goal, self.settings.beta)
            step = self.settings.alpha * metric * free_energy.descent
            length = float(np.hypot(step[0], step[1]))
            self.pose = self._clip_to_map(self.pose + step * min(1.0, self.settings.max_step / max(length, 1e-12)))
            g, dg = self.model.predict(self.pose)
        self._prediction = g, dg
        free_energy = FreeEnergy(ranges, g[used], dg[used], precision, g_goal, self.settings.beta)
        # A scan without any measured beam keeps the misfit of the previous scan.
        misfit = float(np.mean(np.abs(ranges - g[used]))) if len(ranges) else (self._misfits or [np.inf])[-1]
        state = self._update_state(float(np.hypot(*(self.pose - previous)[:2])), misfit)
        return PaperEstimate(self.pose.copy(), g, free_energy, state)

    def _clip_to_map(self, pose: Array) -> Array:
        x0, y0, x1, y1 = self.bounds
        return np.array([min(max(pose[0], x0), x1), min(max(pose[1], y0), y1), pose[2]])

    def _update_state(self, step: float, misfit: float) -> State:
        """The state: tracking once steps are short and the misfit is near the model's error; lost once it is not."""
        window = self.settings.window
        self._steps = [*self._steps, step][-window:]
        self._misfits = [*self._misfits, misfit][-window:]
        fits = float(np.mean(self._misfits)) < self.settings.settled_misfit * self.model_error
        settled = len(self._steps) == window and float(np.mean(self._steps)) < self.settings.settled_step
        if self._was_tracking:
            # The limit is twice that for the start of tracking, so that the state does not flicker.
            self._was_tracking = float(np.mean(self._misfits)) < 2 * self.settings.settled_misfit * self.model_error
            return "tracking" if self._was_tracking else "lost"
        self._was_tracking = settled and fits
        return "tracking" if self._was_tracking else "localising"
