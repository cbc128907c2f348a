"""The SHA-256 of a weights file, checked when it is loaded."""

from __future__ import annotations

import functools
import hashlib
import logging
from typing import TYPE_CHECKING

from common.errors import UserError

if TYPE_CHECKING:
    from pathlib import Path


def sha256(data: bytes) -> str:
    """Returns the SHA-256 of ``data`` in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def check_digest(path: Path, data: bytes, expected: str, command: str) -> None:
    """Raises UserError if the digest of ``data``, read from ``path``, is not ``expected``, the one in the model card.

    Cards written before digests existed have an empty one. They are accepted with a warning, because old recordings
    contain such cards. ``command`` is the command that trains the weights.
    """
    if not expected:
        _warn_once(path, command)
    elif sha256(data) != expected:
        raise UserError(
            f"weights {path}: the file is damaged or belongs to another model card, because its SHA-256 is not the "
            f"one in {path.with_suffix('.json').name}. Restore both files, or train again with: {command}"
        )


@functools.cache
def _warn_once(path: Path, command: str) -> None:
    logging.getLogger("estimator").warning(
        "%s: the model card has no digest, so damage to the file cannot be detected; train again to add one: %s",
        path,
        command,
    )
