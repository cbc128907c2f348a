"""Real logs as cases: one half of a drive, localised in what the other half learned."""

from __future__ import annotations

import functools
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from common.geometry import se2
from lab.experiments.trials import run_key
from lab.integrity.cases import IntegrityTrial
from lab.integrity.maps import grid_of
from lab.real_logs.drive import START_COVARIANCE, drive_at, training_scans
from presage.learning.train_drive import TrainDriveOptions, card_of, scanner_of
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.calibration import ReferenceDrive
from services.estimator.precise.learning.drive_learning import learn_drive
from services.estimator.precise.learning.field_learning import Recipe
from services.estimator.shared.interface import Observation


@dataclass(frozen=True)
class LogCase:
    """Localisation of the second half of a log with reference poses, or of the first if the halves are exchanged."""

    log: str
    mount: tuple[float, float, float] | None  # pose of the laser in base_link; None for the log's own
    exchanged: bool
    odometry: bool

    @property
    def drive_name(self) -> str:
        """Name of the log, and which half is localised."""
        path = Path(self.log)
        stem = path.parent.name if path.stem == "log" else path.stem
        return f"{stem}-{'first' if self.exchanged else 'second'}"

    @property
    def map_name(self) -> str:
        """Name of the map, and of the weights learned for it; another log or mount has another one."""
        return f"{self.drive_name}-{_map_key(replace(self, odometry=False))[:8]}"

    @property
    def name(self) -> str:
        """Name of the case."""
        return f"{self.drive_name}-{'odometry' if self.odometry else 'laser'}"

    def halves(self) -> tuple[ReferenceDrive, ReferenceDrive]:
        """The half from which the map is made, and the half that is localised."""
        drive = drive_at(self.log, self.mount, exchanged=self.exchanged)
        size, numbers = training_scans(self.log, self.mount, exchanged=self.exchanged), np.arange(len(drive.ranges))
        return drive.part(numbers < size), drive.part(numbers >= size)


@functools.cache
def _map_key(case: LogCase) -> str:
    """`run_key` of a case; cached, because it reads the log."""
    return run_key([case])


def cases_of(log: str, mount: tuple[float, float, float] | None) -> list[LogCase]:
    """The cases of one log; those with odometry only if the log has it."""
    kinds = [False] if drive_at(log, mount, exchanged=False).odom is None else [False, True]
    return [LogCase(log, mount, exchanged, odometry) for exchanged in (False, True) for odometry in kinds]


def log_trial(case: LogCase) -> IntegrityTrial:
    """The scans of the half that is localised, in an occupancy grid of the other half."""
    learned, drive = case.halves()
    observations = [
        Observation(
            ranges,
            drive.angles,
            drive.range_max,
            float(drive.stamps[k]),
            se2.known_pose(drive.odom, k) if case.odometry else None,
        )
        for k, ranges in enumerate(drive.ranges)
    ]
    return IntegrityTrial(
        map_world=grid_of(case.map_name, learned),
        scanner=scanner_of(drive, 0.0, case.drive_name),
        observations=observations,
        truths=drive.poses,
        start=(drive.poses[0], START_COVARIANCE),
        map_is_correct=False,  # rooms were changed between the halves, or were not visited in the first one
        kidnappings=np.zeros(0, int),
        separate=False,
    )


def log_field_file(folder: Path, case: LogCase) -> Path:
    """The weights learned from the other half, learned now unless the folder has them."""
    path = weights.path_of(folder, case.map_name)
    if not path.exists():
        start = time.monotonic()
        options = TrainDriveOptions(Path(case.log), share=0.5, recipe=Recipe(resolution=0.05))
        drive, _ = case.halves()
        learned = learn_drive(drive, options.recipe, None, lambda _stage, _done: None)
        card = card_of(options, grid_of(case.map_name, drive), drive, learned, time.monotonic() - start)
        weights.save(path, learned.model, learned.places, card)
    return path
