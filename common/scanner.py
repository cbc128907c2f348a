"""Laser scanners as data."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from common.errors import UserError, first_fault

if TYPE_CHECKING:
    from common.se2 import Array


class Scanner(BaseModel):
    """A planar scanner: geometry of its beams, limits, noise and mounting."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    beams: Annotated[int, Field(ge=2, le=100_000)]
    fov: Annotated[float, Field(gt=0, le=2 * np.pi)]  # rad, from the first beam to the last, centred on x
    rate: Annotated[float, Field(gt=0, le=1000)]  # Hz
    range_min: Annotated[float, Field(ge=0)]  # m
    range_max: Annotated[float, Field(gt=0)]  # m
    sigma: Annotated[float, Field(ge=0)]  # m, standard deviation of a range
    mount: tuple[float, float, float] = (0.0, 0.0, 0.0)  # x m, y m, yaw rad in base_link

    @property
    def angle_min(self) -> float:
        """First beam, rad in laser."""
        return -self.fov / 2

    @property
    def angle_increment(self) -> float:
        """Between beams, rad."""
        return self.fov / (self.beams - 1)

    def angles(self) -> Array:
        """(B,) beam directions, rad in laser."""
        return self.angle_min + self.angle_increment * np.arange(self.beams, dtype=np.float64)

    def with_beams(self, beams: int | None) -> Scanner:
        """The same scanner with another number over the same field of view; raises UserError for an impossible one."""
        if beams is None:
            return self
        try:
            return Scanner.model_validate({**self.model_dump(), "beams": beams})
        except ValidationError as error:
            raise UserError(f"{self.name} with {beams} beams: {first_fault(error)}") from None

    def limit(self, ranges: Array) -> Array:
        """Ranges beyond the scanner's limits as it reports them (REP-117): +inf too far, -inf too close."""
        far = np.where(ranges > self.range_max, np.inf, ranges)
        return np.where(far < self.range_min, -np.inf, far)


SCANNERS: dict[str, Scanner] = {
    # SICK TiM571 data sheet: 270 deg, 1/3 deg, 15 Hz, 0.05 to 25 m, 20 mm statistical error; mounted as on PAL's PMB-2.
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
}
