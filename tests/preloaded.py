"""Imported by the fork server: loads numba's compiled code, so that forked services need not."""

import os
import signal

from common.processes import end_with_parent
from services.controller.policies import grid_paths
from services.estimator.factory import EstimatorOptions, prepare_factory

grid_paths.prepare()
for model in ("learned", "exact"):
    prepare_factory(EstimatorOptions(model=model))

# A fork server outlives a worker that pytest-timeout has ended, as long as there are children; these end with it.
end_with_parent(os.getppid(), signal.SIGKILL)
