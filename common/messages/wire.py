"""Encodes messages as MessagePack maps and validates them when decoding.

Encoding, validation and the JSON schema are derived from the fields of a `Message` class.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import msgpack
import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic_core import CoreSchema, core_schema

from common.limits import MAX_BEAMS, MAX_COORDINATE_M, MAX_DISTANCE_M

if TYPE_CHECKING:
    from pydantic.json_schema import JsonSchemaValue
    from typing_extensions import Self

ENCODING = "application/msgpack"
FROM_WIRE: dict[str, bool] = {"wire": True}  # validation context of payloads, in which arrays must be binary


class DecodeError(ValueError):
    """Raised if a payload is not a valid message; the text names the field and the problem."""


@dataclass(frozen=True)
class Binary:
    """Schema of an array field of shape (N, *row) with elements of type ``dtype``.

    ``values`` are the allowed numbers: ``finite``, or ``ranges`` (REP-117: +inf is no return, -inf is too close, NaN is
    not allowed). ``largest`` limits the magnitude of finite numbers, ``max_rows`` the number of rows.
    """

    dtype: Literal["<f4", "<f8", "u1"]
    row: tuple[int, ...] = ()
    values: Literal["finite", "ranges"] = "finite"
    largest: float | None = None
    max_rows: int | None = None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        """Accepts bytes or anything that numpy converts; stores a read-only array, and serialises it as bytes."""
        return core_schema.with_info_plain_validator_function(
            self.validate,
            serialization=core_schema.plain_serializer_function_ser_schema(lambda array: array.tobytes()),
        )

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """Describes the bytes with keys that begin with x-, as JSON has no equivalent of MessagePack's bin type."""
        limits = {"x-largest": self.largest, "x-max-rows": self.max_rows}
        return {
            "type": "string",
            "contentEncoding": "binary",
            "x-dtype": self.dtype,
            "x-shape": ["N", *self.row],
            **{name: limit for name, limit in limits.items() if limit is not None},
        }

    def validate(self, value: Any, info: core_schema.ValidationInfo) -> npt.NDArray[Any]:
        """Converts to an array of shape (N, *row); raises ValueError for a wrong length, type or number."""
        dtype = np.dtype(self.dtype)
        if isinstance(value, bytes):
            if len(value) % (dtype.itemsize * int(np.prod(self.row))):
                raise ValueError(f"{len(value)} bytes are not a whole number of rows {self.row} of {self.dtype}")
            array = np.frombuffer(value, dtype)
        elif isinstance(value, np.ndarray | list | tuple) and info.context is not FROM_WIRE:
            array = np.array(value, dtype, order="C")
        else:
            raise ValueError(f"binary data of {self.dtype} expected, not {type(value).__name__}")
        array = array.reshape(-1, *self.row)
        if self.max_rows is not None and len(array) > self.max_rows:
            raise ValueError(f"{len(array)} values are more than {self.max_rows}")
        invalid = np.isnan(array) if self.values == "ranges" else ~np.isfinite(array)
        if invalid.any():
            problem = "NaN" if self.values == "ranges" else "not finite"
            raise ValueError(f"{np.count_nonzero(invalid)} values are {problem}")
        if self.largest is not None and (large := np.isfinite(array) & (np.abs(array) > self.largest)).any():
            raise ValueError(f"{np.count_nonzero(large)} values are beyond {self.largest:g}")
        array.setflags(write=False)
        return array


Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, ge=0)]
Count = Annotated[int, Field(ge=0, lt=2**63)]
Text = Annotated[str, Field(max_length=1_000_000)]
Name = Annotated[str, Field(max_length=200)]

Ranges = Annotated[npt.NDArray[np.float32], Binary("<f4", values="ranges", largest=MAX_DISTANCE_M)]
ScanRanges = Annotated[
    npt.NDArray[np.float32], Binary("<f4", values="ranges", largest=MAX_DISTANCE_M, max_rows=MAX_BEAMS)
]
Costs = Annotated[npt.NDArray[np.float32], Binary("<f4", values="ranges")]
Floats = Annotated[npt.NDArray[np.float32], Binary("<f4")]
Bytes = Annotated[npt.NDArray[np.uint8], Binary("u1")]
Points = Annotated[npt.NDArray[np.float32], Binary("<f4", (2,), largest=MAX_COORDINATE_M)]
Poses = Annotated[npt.NDArray[np.float64], Binary("<f8", (3,), largest=MAX_COORDINATE_M)]
Matrix3 = Annotated[npt.NDArray[np.float64], Binary("<f8", (3,))]


class Message(BaseModel):
    """Base of all messages: immutable and validated. Two messages are equal if their encoded bytes are."""

    model_config = ConfigDict(frozen=True, strict=True, extra="ignore", arbitrary_types_allowed=True)

    def encode(self) -> bytes:
        """Encodes as MessagePack."""
        return bytes(msgpack.packb(self.model_dump()))

    @classmethod
    def decode(cls, payload: bytes) -> Self:
        """Decodes and validates a payload; raises DecodeError, and nothing else, for any invalid bytes."""
        try:
            return cls.model_validate(msgpack.unpackb(payload), context=FROM_WIRE)
        except ValidationError as error:
            first = error.errors(include_url=False, include_context=False, include_input=False)[0]
            field = ".".join(map(str, first["loc"])) or "payload"
            raise DecodeError(f"{cls.__name__}.{field}: {first['msg']}") from None
        except Exception as error:  # noqa: BLE001 - msgpack raises many kinds of errors for hostile payloads
            raise DecodeError(f"{cls.__name__}: not valid MessagePack ({type(error).__name__}: {error})") from None

    @classmethod
    def json_schema(cls) -> dict[str, Any]:
        """JSON schema of the fields, for recordings, documentation and other languages."""
        return cls.model_json_schema(mode="serialization")

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Message) and self.encode() == other.encode()

    def __hash__(self) -> int:
        return hash(self.encode())
