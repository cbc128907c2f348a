"""Learns the field while driving, in a separate process, so that learning does not slow down tracking."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING

import numpy as np

from common.processes import end_with_parent
from services.estimator.precise.learning import weights
from services.estimator.precise.learning.key_scans import KeyScanCollector
from services.estimator.precise.learning.live_learning import ModelVersion, learn_version

if TYPE_CHECKING:
    from common.geometry.se2 import Array
    from services.estimator.factory import ScannerGeometry
    from services.estimator.precise.estimator import PreciseEstimator
    from services.estimator.precise.learning.calibration import ReferenceDrive
    from services.estimator.shared.generative_models import GenerativeModel
    from services.estimator.shared.interface import Observation, Posterior

NICENESS = 10  # of the learning process: other services get the processor first, but learning still goes on


@dataclass(frozen=True)
class EncodedVersion:
    """A version of the model, and its encoding, from which another process decodes the same model."""

    version: ModelVersion
    data: bytes


@dataclass(frozen=True)
class LearningOutcome:
    """The result of learning a version of the model."""

    version: EncodedVersion | None  # None if it predicts held-out key scans no better than the model in use


class Learner:
    """Collects key scans, and learns a version of the model whenever enough of them are new."""

    def __init__(self, estimator: PreciseEstimator, geometry: ScannerGeometry) -> None:
        """The model of the ``estimator`` is the original one."""
        self.keys = KeyScanCollector(geometry.angles, geometry.mount, geometry.range_max, estimator.settings.motion)
        self._original, self._places = estimator.model, estimator.seeds.places
        self._pool = ThreadPoolExecutor(1, "learner")
        self._process: BaseProcess | None = None
        self._closed = False
        self._running: Future[EncodedVersion | None] | None = None
        self._stamps = np.zeros(0)  # (N,) of the key scans from which a version is being learned
        self.rejected_total = 0  # versions that were no better than the model in use

    def add(self, posterior: Posterior, observation: Observation, present: GenerativeModel) -> None:
        """Adds a scan, and starts learning if enough key scans are new; ``present`` is the model in use."""
        self.keys.add(posterior, observation)
        if self._running is None and (drive := self.keys.take_drive()) is not None:
            self._stamps = drive.stamps
            self._running = self._pool.submit(self._learn, present, drive, self.keys.learned_until)

    def take(self) -> LearningOutcome | None:
        """Returns the outcome if learning has ended since the last call, or None; raises RuntimeError if it failed.

        The next version starts with the poses at which the key scans agree best in this one.
        """
        if self._running is None or not self._running.done():
            return None
        done, self._running = self._running, None
        if (learned := done.result()) is None:
            self.rejected_total += 1
        else:
            self.keys.set_learned(self._stamps, learned.version.key_poses)
        return LearningOutcome(learned)

    def close(self) -> None:
        """Terminates the learning process."""
        self._closed = True
        self._pool.shutdown(wait=False, cancel_futures=True)
        if (process := self._process) is not None:
            process.terminate()

    def _learn(self, present: GenerativeModel, drive: ReferenceDrive, learned_until: float) -> EncodedVersion | None:
        # Forking would copy the locks of threads. `start` takes a while, as it sends the arguments to the new process.
        context = multiprocessing.get_context("spawn")
        receiver, sender = context.Pipe(duplex=False)
        process = context.Process(
            target=_learn_and_send,
            args=(sender, os.getpid(), self._original, self._places, present, drive, learned_until),
            daemon=True,
        )
        process.start()
        self._process = process  # only now, because a process that has not started cannot be terminated
        sender.close()
        if self._closed:
            process.terminate()
        try:
            learned: EncodedVersion | None = receiver.recv()
        except EOFError:
            process.join()
            raise RuntimeError(f"the process that learns ended with status {process.exitcode}") from None
        process.join()
        return learned


def _learn_and_send(
    sender: Connection,
    parent: int,
    original: GenerativeModel,
    places: Array,
    present: GenerativeModel,
    drive: ReferenceDrive,
    learned_until: float,
) -> None:
    end_with_parent(parent)
    os.nice(NICENESS)
    version, learned = learn_version(original, places, present, drive, learned_until=learned_until), None
    if version is not None:
        data = weights.encode(version.model, version.seeds.places)
        model, seeds = weights.decode(data)
        learned = EncodedVersion(replace(version, model=model, seeds=seeds), data)
    sender.send(learned)
