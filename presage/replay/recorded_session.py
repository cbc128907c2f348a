"""Configuration, map and weights stored in a recording."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common.errors import UserError
from common.messages.definitions import Scan
from common.messages.topics import ROOT, SCAN
from common.runtime.config import ServiceSettings
from common.versions import versions
from services.controller.settings import ControllerSettings
from services.estimator.settings import EstimatorSettings
from services.recorder.reader import Recording

SETTINGS: dict[str, type[ServiceSettings]] = {"estimator": EstimatorSettings, "controller": ControllerSettings}
OWN = frozenset({"config", "print_config", *ServiceSettings.model_fields})  # of the process, not of the method
FILE = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9_.-]*\.safetensors")  # a name, never a path


@dataclass(frozen=True)
class Unpacked:
    """Settings of one service that lead to what was recorded, and what is worth saying about them."""

    values: dict[str, Any]  # plain types, by the names of the settings
    notes: tuple[str, ...] = ()


def robot_of(recording: Recording) -> str:
    """Whose session it is; of several robots the one it was recorded for."""
    there = dict.fromkeys(key.split("/")[1] for key in recording.counts() if key.startswith(f"{ROOT}/"))
    named = recording.metadata.get("presage", {}).get("robot", "")
    return named if named in there or not there else next(iter(there))


def recorded_settings(recording: Recording, service: str) -> Unpacked | None:
    """As the service said of itself, less what is about its process; None where it was not recorded."""
    try:
        config = json.loads(recording.metadata[f"config:{service}"]["config"])
        known = SETTINGS[service].model_fields
        values = {name: value for name, value in dict(config).items() if name not in OWN}
    except KeyError:
        return None
    except (ValueError, TypeError):
        raise UserError(f"{recording.path}: the recorded configuration of the {service} is no JSON map") from None
    strange = sorted(values.keys() - known.keys())
    notes = (f"settings of the {service} that this version does not know: {', '.join(strange)}",) if strange else ()
    return Unpacked({name: value for name, value in values.items() if name in known}, notes)


def estimator_settings(recording: Recording, folder: Path, values: dict[str, Any], *, weights: bool = True) -> Unpacked:
    """``values`` with world and (``weights``) model as recorded, written into ``folder`` where they are in the file.

    Weights that are not in the file are looked for where they lay, then among the shipped ones, and taken only if
    their card, and their digest where it was recorded, are the recorded ones; else UserError.
    """
    values = dict(values)
    if (world := world_file(recording, folder)) is not None:
        values["world"] = str(world)
    learned = values.get("estimator", "precise") == "paper" or (
        values.get("estimator", "precise") == "precise" and values.get("model", "learned") != "exact"
    )
    if not learned or not weights:
        return Unpacked(values)
    model = recording.metadata.get("model", {})
    if not model.get("file") or model.get("estimator") != values.get("estimator", "precise"):
        return Unpacked(values, ("the recording does not say which weights were used: those of this world here are",))
    if not FILE.fullmatch(model["file"]):
        raise UserError(f"{recording.path}: weights are named {model['file']!r}, which is no file name")
    found = _from_file(recording, folder, model) or _from_disk(recording, values, model)
    values |= {"models": str(found.parent), "model": "learned"}
    return Unpacked(values)


def check_mount(recording: Recording, settings: EstimatorSettings) -> None:
    """Raises UserError where a recording's mount is only assumed and the weights were trained with another."""
    from presage.logs.scan_files import mount_assumed  # noqa: PLC0415 - numba takes its time
    from services.estimator.factory import Geometry  # noqa: PLC0415
    from services.estimator.service import Models  # noqa: PLC0415

    if mount_assumed(recording):
        scan = next(message for _, message, _ in recording.messages(SCAN) if isinstance(message, Scan))
        Models(settings).factory(replace(Geometry.of_scan(scan), mount_assumed=True))


def world_file(recording: Recording, folder: Path) -> Path | None:
    """The estimator's map, else the world of the session, as a file; None where neither was recorded."""
    text = recording.attachments.get("model/world.yaml", recording.attachments.get("world.yaml"))
    if text is None:
        return None
    (folder / "world.yaml").write_bytes(text)
    return folder / "world.yaml"


def other_versions(recording: Recording, service: str) -> dict[str, tuple[str, str]]:
    """Of packages (and the commit): recorded and here, where they differ."""
    said = recording.metadata.get(f"config:{service}", {})
    return {name: (said[name], here) for name, here in versions().items() if name in said and said[name] != here}


def _from_file(recording: Recording, folder: Path, model: dict[str, str]) -> Path | None:
    data = recording.attachments.get(f"model/{model['file']}")
    if data is None:
        return None
    if model.get("sha256") and hashlib.sha256(data).hexdigest() != model["sha256"]:
        raise UserError(f"{recording.path}: the weights in it are damaged: their digest is not the recorded one")
    (folder / "models").mkdir(exist_ok=True)
    path = folder / "models" / model["file"]
    path.write_bytes(data)
    card = recording.attachments.get(f"model/{path.with_suffix('.json').name}", model["card"].encode())
    path.with_suffix(".json").write_bytes(card)
    return path


def _from_disk(recording: Recording, values: dict[str, Any], model: dict[str, str]) -> Path:
    """Those of the recorded folder or the shipped ones, if they are the recorded ones."""
    from services.estimator.precise.learning.weights import FOLDER  # noqa: PLC0415 - numba takes its time

    folders = [Path(values["models"])] if values.get("models") else []
    asked = Path(str(values.get("model", "")))
    candidates = [asked] if asked.suffix == ".safetensors" else []
    candidates += [folder / model["file"] for folder in (*folders, FOLDER)]
    for path in candidates:
        if path.name == model["file"] and _same(path, model):
            return path
    raise UserError(
        f"{recording.path}: the weights {model['file']} are not in it, and none here are the recorded ones (looked at "
        f"{', '.join(map(str, candidates))}); put them there, or choose a model with `presage rerun --model`"
    )


def _same(path: Path, model: dict[str, str]) -> bool:
    try:
        cards = [json.loads(text) for text in (path.with_suffix(".json").read_text(encoding="utf-8"), model["card"])]
        for card in cards:
            card.pop("weights_sha256", None)  # the same weights had a card without it before it existed
        digest = hashlib.sha256(path.read_bytes()).hexdigest() if model.get("sha256") else ""
        return bool(cards[0] == cards[1]) and digest == model.get("sha256", "")
    except (OSError, ValueError, KeyError, AttributeError):
        return False
