"""Localises a mobile robot in a known world with its laser scanner: the Python API, described in docs/api.md.

The names are imported when they are first used, so that `import presage` takes no time.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.errors import UserError
    from common.geometry.world import World, load_world
    from common.robot.scanner import SCANNERS, Scanner
    from presage.estimator import Estimator
    from presage.laser_scan import LaserScan
    from presage.logs.log import Reading
    from presage.logs.scan_files import Scans, read_scans
    from services.estimator.paper.perception import Descent
    from services.estimator.precise.gauss_newton import GaussNewton, Optimiser
    from services.estimator.precise.likelihood import Evidence, Likelihood
    from services.estimator.shared.generative_models import Expected, GenerativeModel, RayCaster
    from services.estimator.shared.interface import Hypothesis, Posterior, Predicted

__version__ = "0.1.0"

_MODULES = {
    "common.errors": ("UserError",),
    "common.geometry.world": ("World", "load_world"),
    "common.robot.scanner": ("SCANNERS", "Scanner"),
    "presage.estimator": ("Estimator",),
    "presage.laser_scan": ("LaserScan",),
    "presage.logs.log": ("Reading",),
    "presage.logs.scan_files": ("Scans", "read_scans"),
    "services.estimator.paper.perception": ("Descent",),
    "services.estimator.precise.gauss_newton": ("GaussNewton", "Optimiser"),
    "services.estimator.precise.likelihood": ("Evidence", "Likelihood"),
    "services.estimator.shared.generative_models": ("Expected", "GenerativeModel", "RayCaster"),
    "services.estimator.shared.interface": ("Hypothesis", "Posterior", "Predicted"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "SCANNERS",
    "Descent",
    "Estimator",
    "Evidence",
    "Expected",
    "GaussNewton",
    "GenerativeModel",
    "Hypothesis",
    "LaserScan",
    "Likelihood",
    "Optimiser",
    "Posterior",
    "Predicted",
    "RayCaster",
    "Reading",
    "Scanner",
    "Scans",
    "UserError",
    "World",
    "load_world",
    "read_scans",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module 'presage' has no attribute {name!r}")
    return getattr(import_module(_MODULE_OF[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
