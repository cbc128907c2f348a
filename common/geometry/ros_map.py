"""Reads a ROS map (map.yaml and its image) by the rules of nav2's map_server.

A darker pixel is more likely to be occupied; the key `mode` defines how much. In some modes map_server publishes
percentages between free and occupied; `classify_pixels` turns them into free, occupied and unknown cells.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from common.errors import UserError, first_fault
from common.geometry.occupancy_grid import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, OccupancyGrid
from common.limits import Angle, Coordinate

if TYPE_CHECKING:
    from PIL.Image import Image

    from common.geometry.occupancy_grid import Cells
    from common.geometry.se2 import Array

MAP_SAVER_GREYS = (0, 205, 254)  # of map_saver's trinary images: occupied, unknown, free
IMAGE_SUFFIXES = {".pgm", ".png", ".bmp"}
WORLD_KEYS = ("name", "start", "obstacles")  # presage's additional keys, as in world files; map_server ignores them

Fraction = Annotated[float, Field(ge=0, le=1)]


class MapFile(BaseModel):
    """The keys of map.yaml, with map_saver's defaults; unknown keys are ignored, as by map_server."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    image: Annotated[str, Field(min_length=1)]  # path, relative to the folder of map.yaml
    resolution: Annotated[float, Field(gt=0, le=1e3)]  # m, edge length of a pixel
    origin: tuple[Coordinate, Coordinate, Angle]  # x m, y m, yaw rad of the lower left pixel's lower left corner
    negate: bool = False  # lighter pixels are more likely to be occupied
    occupied_thresh: Fraction = 0.65  # above this occupancy, from 0 (white) to 1 (black), a pixel is occupied
    free_thresh: Fraction = 0.25  # below this occupancy, it is free
    mode: Literal["trinary", "scale", "raw"] = "trinary"

    @field_validator("mode", mode="before")
    @classmethod
    def _lower_case_mode(cls, value: object) -> object:
        return value.lower() if isinstance(value, str) else value

    @field_validator("negate", mode="before")
    @classmethod
    def _negate_as_bool(cls, value: object) -> object:
        return value != 0 if isinstance(value, int) else value

    @model_validator(mode="after")
    def _check_thresholds(self) -> MapFile:
        if self.free_thresh >= self.occupied_thresh:
            raise ValueError(f"free_thresh {self.free_thresh:g} must be below occupied_thresh {self.occupied_thresh:g}")
        return self


def is_map(data: object) -> bool:
    """Whether the contents of a YAML file are those of a ROS map, not of a world."""
    return isinstance(data, dict) and bool({"image", "resolution"} & data.keys()) and "boundary" not in data


def read_map(path: Path, data: dict[str, Any]) -> dict[str, Any]:
    """Fields of the World for the ROS map ``path``, whose contents are ``data``.

    Raises UserError if the keys or the image are invalid.
    """
    try:
        map_file = MapFile.model_validate(data)
    except ValidationError as error:
        raise UserError(f"map {path}: {first_fault(error)}") from None
    image = path.parent / map_file.image
    colours, alpha = _pixels(image)
    grid = OccupancyGrid.of(classify_pixels(map_file, colours, alpha)[::-1], map_file.resolution, map_file.origin)
    return {**{key: data[key] for key in WORLD_KEYS if key in data}, "grid": grid}


def classify_pixels(map_file: MapFile, colours: Array, alpha: Array | None) -> Cells:
    """(H, W) cells FREE, OCCUPIED or UNKNOWN, with rows as in the image.

    ``colours`` (H, W, C) and ``alpha`` (H, W) are from 0 to 1. In mode raw, the thresholds are applied to map_server's
    percentages. In the other modes, 0 is free, 100 is occupied and everything between is unknown, as in AMCL.
    """
    percent = percentages(map_file, colours, alpha)
    low, high = (100 * map_file.free_thresh, 100 * map_file.occupied_thresh) if map_file.mode == "raw" else (1, 99)
    cells = np.where(percent > high, OCCUPIED, np.where((percent >= 0) & (percent < low), FREE, UNKNOWN))
    if map_file.mode == "trinary" and not map_file.negate and alpha is None:
        # Until 2025 map_saver wrote free_thresh 0.25, with which its own grey for unknown, 205, would be free.
        grey = np.rint(colours.mean(axis=-1) * 255)
        if np.isin(grey, MAP_SAVER_GREYS).all():
            cells[grey == MAP_SAVER_GREYS[1]] = UNKNOWN
    return cells.astype(np.uint8)


def percentages(map_file: MapFile, colours: Array, alpha: Array | None) -> npt.NDArray[np.int_]:
    """(H, W) occupancy as map_server publishes it: 0 to 100, or -1 for unknown; arguments as of `classify_pixels`."""
    if map_file.mode == "trinary" and alpha is not None:
        colours = np.concatenate([colours, alpha[..., None]], axis=-1)  # map_server averages alpha like a colour
    shade = colours.mean(axis=-1)
    if map_file.mode == "raw":
        raw = np.rint(shade * 255)
        return np.where(raw <= 100, raw, -1).astype(int)
    low, high = map_file.free_thresh, map_file.occupied_thresh
    dark = shade if map_file.negate else 1.0 - shade
    between = np.rint((dark - low) / (high - low) * 100) if map_file.mode == "scale" else -1
    percent = np.where(dark > high, 100, np.where(dark < low, 0, between))
    if map_file.mode == "scale" and alpha is not None:
        percent[alpha < 1] = -1
    return percent.astype(int)


def _pixels(path: Path) -> tuple[Array, Array | None]:
    """Colours (H, W, C) and alpha (H, W) of an image file, from 0 to 1; alpha is None if it has none."""
    try:
        # Imported here because Pillow is an optional dependency.
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise UserError(f"map image {path}: reading it needs the package Pillow: pip install pillow") from None
    if path.exists() and not path.is_file():  # opening a pipe would block
        raise UserError(f"map image {path}: a folder, pipe or device, not a file")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as image:
                if image.width * image.height > MAX_CELLS:
                    raise _too_large(path)
                return _normalised(image)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):  # for much larger images
        raise _too_large(path) from None
    except FileNotFoundError:
        raise UserError(
            f"map image {path}: no such file (the key image is a path relative to the folder of map.yaml)"
        ) from None
    except UnidentifiedImageError:
        raise UserError(f"map image {path}: not an image; use PGM, PNG or BMP") from None
    except (OSError, ValueError, SyntaxError) as error:
        raise UserError(f"map image {path}: cannot be read ({' '.join(str(error).split())})") from None


def _too_large(path: Path) -> UserError:
    return UserError(
        f"map image {path}: more than {MAX_CELLS} pixels; crop it, or scale it down and make the resolution coarser"
    )


def _normalised(image: Image) -> tuple[Array, Array | None]:
    """Colours and alpha of an image of any pixel type, as `_pixels` returns them."""
    if image.mode == "F":
        raise ValueError("its pixels are floating-point numbers, use 8 or 16 bits")
    if image.mode.startswith("I"):  # 16 bits per pixel, which Pillow may hold in 32
        return np.asarray(image, float)[..., None] / 65535, None
    mode = "RGBA" if image.has_transparency_data else "RGB"
    values = np.asarray(image if image.mode in {"L", mode} else image.convert(mode), np.uint8)
    values = values.reshape(*values.shape[:2], -1)  # also one grey channel gets an axis
    return values[..., :3] / 255, values[..., 3] / 255 if values.shape[2] == 4 else None
