"""Reads a ROS map (map.yaml and its image) by the rules of nav2's map_server.

How dark a pixel is says how sure it is that something stands there; the mode says what becomes of it. Where map_server
leaves a percentage between free and occupied, presage has to say what that is: see `_percent`.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from common.errors import UserError
from common.geometry.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, OccupancyGrid
from common.limits import Angle, Coordinate

if TYPE_CHECKING:
    from PIL.Image import Image

    from common.geometry.occupancy_grid import Cells
    from common.geometry.se2 import Array

SAVED = (0, 205, 254)  # what map_saver paints in mode trinary: occupied, unknown, free
IMAGES = {".pgm", ".png", ".bmp"}
OWN = ("name", "start", "obstacles")  # keys map_server does not know; presage's own, as in its world files

Share = Annotated[float, Field(ge=0, le=1)]


class MapFile(BaseModel):
    """The keys of map.yaml; others are not looked at, as map_server does not. Defaults are map_saver's."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    image: Annotated[str, Field(min_length=1)]  # path, from the folder of map.yaml
    resolution: Annotated[float, Field(gt=0, le=1e3)]  # m, a pixel's edge
    origin: tuple[Coordinate, Coordinate, Angle]  # m, m, rad: lower left corner of the lower left pixel
    negate: bool = False  # white is occupied
    occupied_thresh: Share = 0.65  # darker is occupied
    free_thresh: Share = 0.25  # lighter is free
    mode: Literal["trinary", "scale", "raw"] = "trinary"

    @field_validator("mode", mode="before")
    @classmethod
    def _any_case(cls, value: object) -> object:
        return value.lower() if isinstance(value, str) else value

    @field_validator("negate", mode="before")
    @classmethod
    def _number(cls, value: object) -> object:
        return value != 0 if isinstance(value, int) else value

    @model_validator(mode="after")
    def _in_order(self) -> MapFile:
        if self.free_thresh >= self.occupied_thresh:
            raise ValueError(f"free_thresh {self.free_thresh:g} is not below occupied_thresh {self.occupied_thresh:g}")
        return self


def is_map(data: object) -> bool:
    """Whether YAML's ``data`` are meant as a ROS map and no world."""
    return isinstance(data, dict) and bool({"image", "resolution"} & data.keys()) and "boundary" not in data


def read_map(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """The fields of the World that map.yaml at ``path``, its keys in ``data``, describes; or UserError."""
    try:
        described = MapFile.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise UserError(f"map {path}: {'.'.join(map(str, first['loc'])) or 'file'}: {first['msg']}") from None
    image = path.parent / described.image
    brightness, alpha = _pixels(image)
    grid = OccupancyGrid.of(cells(described, brightness, alpha)[::-1], described.resolution, described.origin)
    name = re.sub(r"[^\w.-]+", "-", path.resolve().stem)
    return {"name": name, **{key: data[key] for key in OWN if key in data}, "grid": grid}


def cells(described: MapFile, colours: Array, alpha: Array | None) -> Cells:
    """(H, W) FREE, OCCUPIED, UNKNOWN of ``colours`` (H, W, C) and ``alpha`` (H, W), 0 to 1; rows as in the image.

    Where map_server leaves a percentage: of mode scale 0 is free, 100 occupied, and the rest unknown, as AMCL takes it;
    of mode raw the thresholds decide.
    """
    percent = percentages(described, colours, alpha)
    low, high = (100 * described.free_thresh, 100 * described.occupied_thresh) if described.mode == "raw" else (1, 99)
    found = np.where(percent > high, OCCUPIED, np.where((percent >= 0) & (percent < low), FREE, UNKNOWN))
    if described.mode == "trinary" and not described.negate and alpha is None:
        # map_saver of 2025 and before wrote free_thresh 0.25, by which its own grey for unknown, 205, would be free.
        grey = np.rint(colours.mean(axis=-1) * 255)
        if np.isin(grey, SAVED).all():
            found[grey == SAVED[1]] = UNKNOWN
    return found.astype(np.uint8)


def percentages(described: MapFile, colours: Array, alpha: Array | None) -> npt.NDArray[np.int_]:
    """(H, W) what map_server publishes: 0 to 100, or -1 for unknown."""
    if described.mode == "trinary" and alpha is not None:
        colours = np.concatenate([colours, alpha[..., None]], axis=-1)  # one more colour to map_server
    shade = colours.mean(axis=-1)
    if described.mode == "raw":
        raw = np.rint(shade * 255)
        return np.where(raw <= 100, raw, -1).astype(int)
    low, high = described.free_thresh, described.occupied_thresh
    dark = shade if described.negate else 1.0 - shade
    between = np.rint((dark - low) / (high - low) * 100) if described.mode == "scale" else -1
    percent = np.where(dark > high, 100, np.where(dark < low, 0, between))
    if described.mode == "scale" and alpha is not None:
        percent[alpha < 1] = -1
    return percent.astype(int)


def _pixels(path: Path) -> tuple[Array, Array | None]:
    """Colours (H, W, C) and alpha (H, W) or None, 0 to 1."""
    try:
        # Only who reads an image needs it.
        from PIL import Image, UnidentifiedImageError  # noqa: PLC0415
    except ImportError:
        raise UserError(f"map image {path}: reading it needs the package Pillow: pip install pillow") from None
    if path.exists() and not path.is_file():  # opening a pipe would wait for its other end
        raise UserError(f"map image {path}: not a file but a folder, a pipe or a device")
    try:
        with Image.open(path) as image:
            if image.width * image.height > MAX_CELLS:
                raise UserError(
                    f"map image {path}: {image.width} x {image.height} pixels are more than {MAX_CELLS}; "
                    "crop it, or scale it down and make the resolution coarser"
                )
            return _shares(image)
    except FileNotFoundError:
        raise UserError(f"map image {path}: no such file (image: in map.yaml is a path from its folder)") from None
    except UnidentifiedImageError:
        raise UserError(f"map image {path}: no image; PGM, PNG and BMP are read") from None
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError, Warning) as error:
        raise UserError(f"map image {path}: cannot be read ({' '.join(str(error).split())})") from None


def _shares(image: Image) -> tuple[Array, Array | None]:
    """Of an image of any kind."""
    if image.mode.startswith(("I", "F")):  # 16 bits a pixel
        return np.asarray(image, float)[..., None] / 65535, None
    wanted = "RGBA" if image.has_transparency_data else "RGB"
    values = np.asarray(image if image.mode in {"L", wanted} else image.convert(wanted), np.uint8)
    values = values.reshape(*values.shape[:2], -1)
    return values[..., :3] / 255, values[..., 3] / 255 if values.shape[2] == 4 else None
