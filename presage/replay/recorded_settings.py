"""Configuration, map and weights stored in a recording."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError

from common.errors import UserError, first_fault
from common.runtime.config import ServiceSettings
from common.versions import versions
from services.controller.settings import ControllerSettings
from services.estimator.settings import EstimatorSettings
from services.estimator.shared.model_folder import SHIPPED, training_folder
from services.recorder.reader import Recording

S = TypeVar("S", bound=ServiceSettings)
SETTINGS: dict[str, type[ServiceSettings]] = {"estimator": EstimatorSettings, "controller": ControllerSettings}
# Settings of the process such as endpoints, which must not be taken from a recording.
PROCESS_SETTINGS = frozenset({"config", "print_config", *ServiceSettings.model_fields})
WEIGHTS_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*\.safetensors")  # a file name, never a path


@dataclass(frozen=True)
class RecordedSettings:
    """Settings of one service as recorded, with notes for the user."""

    values: dict[str, Any]  # by name of the setting
    notes: tuple[str, ...] = ()


def recorded_settings(recording: Recording, service: str) -> RecordedSettings | None:
    """The recorded settings of a service, without those of its process; None if they were not recorded."""
    try:
        config = json.loads(recording.metadata[f"config:{service}"]["config"])
        known = SETTINGS[service].model_fields
        values = {name: value for name, value in dict(config).items() if name not in PROCESS_SETTINGS}
    except KeyError:
        return None
    except (ValueError, TypeError):
        raise UserError(f"{recording.path}: the recorded configuration of the {service} is not a JSON object") from None
    unknown = sorted(values.keys() - known.keys())
    notes = (f"settings of the {service} that this version does not know: {', '.join(unknown)}",) if unknown else ()
    return RecordedSettings({name: value for name, value in values.items() if name in known}, notes)


def settings_with(kind: type[S], values: dict[str, Any]) -> S:
    """Settings of a service with these values, else with its defaults, whatever the environment variables say.

    Raises UserError if a value is invalid.
    """
    defaults = {name: field.get_default(call_default_factory=True) for name, field in kind.model_fields.items()}
    try:
        return kind(**{**defaults, **values})
    except ValidationError as error:
        raise UserError(f"setting of the {kind.service}: {first_fault(error)}") from None


def estimator_settings(
    recording: Recording, folder: Path, values: dict[str, Any], *, weights: bool = True
) -> RecordedSettings:
    """``values`` with the recorded world and, with ``weights``, the recorded model, written as files into ``folder``.

    Weights that are not in the recording are searched in their recorded folder, then among the shipped weights. Raises
    UserError unless their card, and their digest if it was recorded, are the recorded ones.
    """
    values = dict(values)
    if (world := world_file(recording, folder)) is not None:
        values["world"] = str(world)
    learned = values.get("estimator", "precise") == "paper" or (
        values.get("estimator", "precise") == "precise" and values.get("model", "learned") != "exact"
    )
    if not learned or not weights:
        return RecordedSettings(values)
    model = recording.metadata.get("model", {})
    if not model.get("file") or model.get("estimator") != values.get("estimator", "precise"):
        return RecordedSettings(
            values, ("the recording does not state which weights were used: using those of this world",)
        )
    if not WEIGHTS_NAME.fullmatch(model["file"]):
        raise UserError(f"{recording.path}: weights are named {model['file']!r}, which is not a file name")
    weights_file = _extract_weights(recording, folder, model) or _find_weights(recording, values, model)
    values |= {"models": str(weights_file.parent), "model": "learned"}
    return RecordedSettings(values)


def world_file(recording: Recording, folder: Path) -> Path | None:
    """Writes the estimator's map, else the world of the session, to a file; None if neither was recorded."""
    text = recording.attachments.get("model/world.yaml", recording.attachments.get("world.yaml"))
    if text is None:
        return None
    (folder / "world.yaml").write_bytes(text)
    return folder / "world.yaml"


def other_versions(recording: Recording, service: str) -> dict[str, tuple[str, str]]:
    """Packages (and the commit) whose version differs: {name: (recorded version, version here)}."""
    recorded = recording.metadata.get(f"config:{service}", {})
    return {
        name: (recorded[name], here) for name, here in versions().items() if name in recorded and recorded[name] != here
    }


def _extract_weights(recording: Recording, folder: Path, model: dict[str, str]) -> Path | None:
    data = recording.attachments.get(f"model/{model['file']}")
    if data is None:
        return None
    if model.get("sha256") and hashlib.sha256(data).hexdigest() != model["sha256"]:
        raise UserError(f"{recording.path}: the weights in it are damaged: their digest differs from the recorded one")
    (folder / "models").mkdir(exist_ok=True)
    path = folder / "models" / model["file"]
    path.write_bytes(data)
    card = recording.attachments.get(f"model/{path.with_suffix('.json').name}", model["card"].encode())
    path.with_suffix(".json").write_bytes(card)
    return path


def _find_weights(recording: Recording, values: dict[str, Any], model: dict[str, str]) -> Path:
    """The recorded weights in the recorded folder or among the shipped ones; raises UserError if they are not there."""
    folders = [Path(values["models"])] if values.get("models") else []
    recorded_file = Path(str(values.get("model", "")))
    candidates = [recorded_file] if recorded_file.suffix == ".safetensors" else []
    candidates += [folder / model["file"] for folder in (*folders, training_folder(), SHIPPED)]
    for path in candidates:
        if path.name == model["file"] and _are_recorded_weights(path, model):
            return path
    raise UserError(
        f"{recording.path}: the weights {model['file']} are not in it, and none here are the recorded ones (searched "
        f"{', '.join(map(str, candidates))}); copy them there, or choose a model with `presage rerun --model`"
    )


def _are_recorded_weights(path: Path, model: dict[str, str]) -> bool:
    try:
        cards = [json.loads(text) for text in (path.with_suffix(".json").read_text(encoding="utf-8"), model["card"])]
        for card in cards:
            card.pop("weights_sha256", None)  # older cards of the same weights lack it
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if model.get("sha256") else ""
        return bool(cards[0] == cards[1]) and digest == model.get("sha256", "")
    except (OSError, ValueError, KeyError, AttributeError):
        return False
