"""Laser scanners: field of view, rate, range and noise of each known model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from common.errors import UserError, first_fault
from common.limits import MAX_BEAMS, Angle, Coordinate, Distance, PositiveDistance

if TYPE_CHECKING:
    from common.geometry.se2 import Array


class Scanner(BaseModel):
    """A planar laser scanner: geometry of its beams, limits, noise and mounting."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: Annotated[str, Field(min_length=1, max_length=200)]
    beams: Annotated[int, Field(ge=2, le=MAX_BEAMS)]
    fov: Annotated[float, Field(gt=0, le=2 * np.pi + 1e-9)]  # rad, from the first beam to the last
    rate: Annotated[float, Field(gt=0, le=1000)]  # Hz
    range_min: Distance  # m
    range_max: PositiveDistance  # m
    sigma: Distance  # m, standard deviation of a range
    mount: tuple[Coordinate, Coordinate, Angle] = (0.0, 0.0, 0.0)  # x m, y m, yaw rad in base_link
    sigma_relative: Annotated[float, Field(ge=0, le=1)] = 0.0  # part proportional to the range, added in quadrature
    # rad, first beam in the scanner's frame, counter-clockwise; nil: -fov / 2
    first: Annotated[float, Field(ge=-2 * np.pi, le=2 * np.pi)] | None = None
    upside_down: bool = False  # a roll of 180 deg: beams run clockwise seen from above

    @model_validator(mode="after")
    def _check_range_limits(self) -> Scanner:
        if self.range_max <= self.range_min:
            raise ValueError(f"range_max {self.range_max:g} m must be more than range_min {self.range_min:g} m")
        return self

    @property
    def angle_min(self) -> float:
        """Direction of the first beam, rad in laser, whose z axis points up in any mounting."""
        first = -self.fov / 2 if self.first is None else self.first
        return -first if self.upside_down else first

    @property
    def angle_increment(self) -> float:
        """Angle between beams, rad; negative if they run clockwise."""
        step = self.fov / (self.beams - 1)
        return -step if self.upside_down else step

    @property
    def turn_per_beam(self) -> float:
        """Angle between beams as a share of a full turn."""
        return abs(self.angle_increment) / (2 * np.pi)

    def angles(self) -> Array:
        """(B,) beam directions, rad in laser."""
        return self.angle_min + self.angle_increment * np.arange(self.beams, dtype=np.float64)

    def with_beams(self, beams: int | None) -> Scanner:
        """A copy with another number of beams over the same field of view; None keeps the number.

        Raises UserError for an invalid number.
        """
        if beams is None:
            return self
        try:
            return Scanner.model_validate({**self.model_dump(), "beams": beams})
        except ValidationError as error:
            raise UserError(f"{self.name} with {beams} beams: {first_fault(error)}") from None

    def deviation(self, ranges: Array) -> Array:
        """Standard deviation in m of measurements of ``ranges`` m, of the same shape."""
        if not self.sigma_relative:  # 0 times inf would be NaN
            return np.full(np.shape(ranges), self.sigma)
        return np.hypot(self.sigma, self.sigma_relative * np.asarray(ranges))

    def add_noise(self, ranges: Array, rng: np.random.Generator) -> Array:
        """Adds this scanner's noise to exact ``ranges`` in m; +inf stays +inf."""
        draws = rng.standard_normal(np.shape(ranges))
        finite = np.where(np.isfinite(ranges), ranges, 0.0)
        return np.asarray(ranges + self.deviation(finite) * draws)

    def limit(self, ranges: Array) -> Array:
        """Replaces ranges beyond the scanner's limits (REP-117): +inf for too far, -inf for too close."""
        far = np.where(ranges > self.range_max, np.inf, ranges)
        return np.where(far < self.range_min, -np.inf, far)

    def __str__(self) -> str:
        x, y, yaw = self.mount
        relative = f" and {self.sigma_relative:.2g} times the range" if self.sigma_relative else ""
        return (
            f"{self.name}: {self.beams} beams over {np.rad2deg(self.fov):.4g} deg from "
            f"{np.rad2deg(self.angle_min):.4g} deg, {self.rate:g} Hz, {self.range_min:g} to {self.range_max:g} m, "
            f"sigma {self.sigma * 1e3:g} mm{relative}; "
            f"mounted at ({x:g}, {y:g}) m, {np.rad2deg(yaw):.4g} deg{', upside down' if self.upside_down else ''}"
        )


# Values from the manufacturers' data sheets. Comments give a substitute where a sheet states no standard deviation.
SCANNERS: dict[str, Scanner] = {
    # SICK TiM571-2050101: 270 deg, 1/3 deg, 15 Hz, 0.05 to 25 m, statistical error 20 mm (1 sigma); mounted as on PAL's
    # PMB-2.
    "tim571": Scanner(
        name="tim571",
        beams=811,
        fov=float(np.deg2rad(270)),
        rate=15.0,
        range_min=0.05,
        range_max=25.0,
        sigma=0.02,
        mount=(0.2, 0.0, 0.0),
    ),
    # Hokuyo UST-10LX: 270 deg, 0.25 deg, 25 ms per scan, 0.06 to 10 m, repeated accuracy sigma < 30 mm (upper limit).
    "ust-10lx": Scanner(
        name="ust-10lx",
        beams=1081,
        fov=float(np.deg2rad(270)),
        rate=40.0,
        range_min=0.06,
        range_max=10.0,
        sigma=0.03,
        mount=(0.2, 0.0, 0.0),
    ),
    # SICK LMS 200 at 180 deg and 1 deg: 13.3 ms per scan, statistical error 5 mm (1 sigma) within 8 m in millimetre
    # mode, whose largest value is 8.19 m. No minimum range is given.
    "lms200": Scanner(
        name="lms200",
        beams=181,
        fov=float(np.deg2rad(180)),
        rate=75.0,
        range_min=0.0,
        range_max=8.19,
        sigma=0.005,
        mount=(0.2, 0.0, 0.0),
    ),
    # Slamtec RPLIDAR A1M8: 360 samples per turn at 5.5 Hz, 0.15 to 12 m, "distance resolution" < 0.5 mm below 1.5 m and
    # < 1 % of the distance everywhere. No statistical error is given, so 1 % is used. The ROS driver publishes 360
    # beams from -179 to 180 deg, so the last beam is one step before the first.
    "rplidar-a1": Scanner(
        name="rplidar-a1",
        beams=360,
        fov=float(np.deg2rad(359)),
        rate=5.5,
        range_min=0.15,
        range_max=12.0,
        sigma=0.0005,
        sigma_relative=0.01,
        first=float(np.deg2rad(-179)),
    ),
}
