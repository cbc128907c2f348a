"""One scan as the Python API takes it: ranges, beam directions, and where the scanner is mounted."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from common.errors import UserError
from common.geometry.se2 import Array
from common.robot.ranges import normalise_driver_ranges, ranges_for_localisation
from services.estimator.factory import ScannerGeometry
from services.estimator.shared.interface import Observation


@dataclass(frozen=True)
class LaserScan(Observation):
    """One scan, with its scanner's mount and noise.

    ``ranges`` are those of a driver: range_max and more mean no return; NaN, 0 and negative values are not used. They
    are stored as estimators need them: +inf for no return, -inf for a beam that is not used. Any pose but the mount
    with NaN or infinity is unknown. Raises UserError if a shape does not fit, or another number is not finite.
    """

    mount: Array = field(default_factory=lambda: np.zeros(3))  # (3,) laser in base_link: m, m, rad
    sigma: float = 0.0  # m, standard deviation of a range; unknown if this and sigma_relative are 0
    sigma_relative: float = 0.0  # its part that grows with the range, as a share
    mount_assumed: bool = False  # whether neither the file nor the user states the mount
    reference: Array | None = None  # (3,) true or reference pose, base_link in map; estimators do not use it

    def __post_init__(self) -> None:
        ranges, angles = np.asarray(self.ranges, float), np.asarray(self.angles, float)
        if ranges.ndim != 1 or ranges.shape != angles.shape:
            raise UserError(f"a scan needs as many ranges as angles, not shapes {ranges.shape} and {angles.shape}")
        mount = self._pose("mount")
        names = ("stamp", "range_max", "time_increment", "sigma", "sigma_relative")
        needed = {"angles": angles, "mount": mount} | {name: getattr(self, name) for name in names}
        for name, numbers in needed.items():
            if numbers is not None and not np.isfinite(numbers).all():
                raise UserError(f"{name} of a scan: NaN and infinity are not allowed")
        ranges = normalise_driver_ranges(ranges, 0.0, self.range_max)
        stored = {"ranges": ranges_for_localisation(ranges), "angles": angles, "mount": mount}
        for name in ("odom", "command", "goal", "reference"):
            pose = self._pose(name)
            stored[name] = pose if pose is not None and np.isfinite(pose).all() else None
        for name, value in stored.items():
            object.__setattr__(self, name, value)

    @property
    def geometry(self) -> ScannerGeometry:
        """Beams, mount and noise of the scanner."""
        return ScannerGeometry(
            self.angles, self.mount, self.range_max, self.sigma, self.sigma_relative, mount_assumed=self.mount_assumed
        )

    def _pose(self, name: str) -> Array | None:
        value = getattr(self, name)
        pose = None if value is None else np.asarray(value, np.float64)
        if pose is not None and pose.shape != (3,):
            raise UserError(f"{name} of a scan has three numbers, not the shape {pose.shape}")
        return pose
