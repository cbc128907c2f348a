"""Builds a scanner from command-line options or a YAML file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from common.errors import UserError, first_fault
from common.geometry.pose_text import parse_pose
from common.geometry.shapes import Degrees
from common.limits import Coordinate
from common.robot.scanner import SCANNERS, Scanner
from common.yaml_text import NOT_YAML, parse_yaml

UNITS = {
    "fov_deg": "degrees",
    "first_deg": "degrees",
    "rate": "Hz",
    "range_min": "m",
    "range_max": "m",
    "sigma": "m",
    "mount": "m, and yaw_deg in degrees",
}


class _Mount(BaseModel):
    model_config = ConfigDict(extra="forbid")

    x: Coordinate = 0.0
    y: Coordinate = 0.0
    yaw_deg: Degrees = 0.0


class _ScannerFile(BaseModel):
    """Contents of a scanner file: SI units, but degrees for keys that end with _deg."""

    model_config = ConfigDict(extra="forbid")

    name: str
    beams: int
    fov_deg: Annotated[float, Field(gt=0, le=360)]
    rate: float  # Hz
    range_min: float = 0.0  # m
    range_max: float  # m
    sigma: float  # m
    sigma_relative: float = 0.0
    first_deg: Annotated[float, Field(ge=-360, le=360)] | None = None
    mount: _Mount = _Mount()
    upside_down: bool = False

    def scanner(self) -> Scanner:
        return Scanner(
            **self.model_dump(exclude={"fov_deg", "first_deg", "mount"}),
            fov=float(np.deg2rad(self.fov_deg)),
            first=None if self.first_deg is None else float(np.deg2rad(self.first_deg)),
            mount=(self.mount.x, self.mount.y, float(np.deg2rad(self.mount.yaw_deg))),
        )


def load_scanner(name: str) -> Scanner:
    """The known scanner called ``name``, or the one described in the YAML file ``name``.

    Raises UserError if there is neither, or if the file is invalid.
    """
    if name in SCANNERS:
        return SCANNERS[name]
    path = Path(name)
    try:
        data = parse_yaml(path.read_text(encoding="utf-8"))
        return _ScannerFile.model_validate(data).scanner()
    except (FileNotFoundError, NotADirectoryError):
        raise UserError(f"no scanner {name!r}: choose one of {', '.join(SCANNERS)}, or give a file") from None
    except ValidationError as error:
        key = ".".join(map(str, error.errors(include_url=False)[0]["loc"]))
        unit = f" ({UNITS[key]})" if key in UNITS else ""
        raise UserError(f"scanner {path}: {first_fault(error)}{unit}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"scanner {path}: cannot be read ({error})") from None
    except NOT_YAML as error:
        raise UserError(f"scanner {path}: not valid YAML ({' '.join(str(error).split())})") from None


def build_scanner(
    name: str, beams: int | None = None, noise: float | None = None, mount: str = "", *, upside_down: bool | None = None
) -> Scanner:
    """`load_scanner` with some properties replaced; raises UserError for invalid ones.

    ``noise`` is the standard deviation of a range in m; ``mount`` is x,y[,yaw_deg] in base_link, in m and degrees.
    Empty text or None keeps the scanner's own value.
    """
    scanner = load_scanner(name).with_beams(beams)
    changes: dict[str, Any] = {}
    if noise is not None:
        changes |= {"sigma": noise, "sigma_relative": 0.0}
    if mount:
        changes["mount"] = tuple(parse_pose(mount, "--mount").tolist())
    if upside_down is not None:
        changes["upside_down"] = upside_down
    try:
        return Scanner.model_validate({**scanner.model_dump(), **changes})
    except ValidationError as error:
        raise UserError(f"scanner {scanner.name}: {first_fault(error)}") from None
