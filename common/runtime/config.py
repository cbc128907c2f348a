"""Settings from defaults, a YAML file, the environment and the command line.

One class a service; the environment's names, the command line and its help follow from the fields.
"""

from __future__ import annotations

import argparse
import inspect
import re
import sys
from contextvars import ContextVar
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

import yaml
from pydantic import Field, ValidationError
from pydantic_settings import (
    BaseSettings,
    CliApp,
    CliSettingsSource,
    EnvSettingsSource,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from common.bus.bus import DEFAULT_ENDPOINT, Link
from common.bus.security import Credentials, credentials
from common.errors import UserError

_file_values: ContextVar[dict[str, Any]] = ContextVar("_file_values")
S = TypeVar("S", bound="ServiceSettings")
METRICS_TEXT = r"^$|^(\[[0-9A-Fa-f:.]+\]:|[^\s:\[\]]+:)?\d{1,5}$"  # PORT, HOST:PORT, [IPv6]:PORT, or nothing


class ServiceSettings(BaseSettings):
    """What every service can be told."""

    model_config = SettingsConfigDict(
        env_prefix="PRESAGE_",
        extra="forbid",
        frozen=True,
        cli_kebab_case=True,
        cli_implicit_flags=True,
        cli_hide_none_type=True,
    )
    service: ClassVar[str] = "service"
    program: ClassVar[str] = ""  # in --help; empty: python -m services.NAME
    # Fields that PRESAGE_<FIELD> and a shared line of the file do not reach: PRESAGE_<SERVICE>_<FIELD> sets them.
    private: ClassVar[frozenset[str]] = frozenset()

    robot: Annotated[
        str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$", description="name in the keys presage/ROBOT/TOPIC")
    ] = "robot"
    connect: Annotated[str, Field(description="zenoh endpoints to connect to, comma-separated; empty: none")] = (
        DEFAULT_ENDPOINT
    )
    listen: Annotated[str, Field(description="zenoh endpoints to listen on, comma-separated; loopback unless told")] = (
        "tcp/127.0.0.1:0"
    )
    multicast: Annotated[bool, Field(description="also find other sessions by multicast")] = False
    lossless: Annotated[
        bool, Field(description="who cannot keep up holds this service back; for replays, not for a robot")
    ] = False
    security: Annotated[
        Path | None, Field(description="folder of credentials (presage secure init): TLS, access by role")
    ] = None
    role: Annotated[str, Field(description="whose credentials of that folder; none: those named like the service")] = ""
    insecure: Annotated[bool, Field(description="without --security: listen beyond loopback all the same")] = False
    log_level: Annotated[
        str, Field(pattern="^(debug|info|warning|error)$", description="debug, info, warning, error")
    ] = "info"
    log_json: Annotated[bool, Field(description="log lines as JSON")] = False
    metrics: Annotated[
        str,
        Field(pattern=METRICS_TEXT, description="PORT or HOST:PORT for Prometheus, 0: any free port; empty: none"),
    ] = ""
    heartbeat: Annotated[
        Path | None, Field(description="folder for a file that says each second how it stands; none: no file")
    ] = None
    config: Annotated[Path | None, Field(description="YAML file of settings, with a section for each service")] = None
    print_config: Annotated[bool, Field(description="print the effective settings as YAML and end")] = False

    def link(self) -> Link:
        """The session these settings ask for."""
        return Link(
            self.robot, split_endpoints(self.connect), split_endpoints(self.listen), multicast=self.multicast,
            lossless=self.lossless, security=self.credentials(), insecure=self.insecure,
        )  # fmt: skip

    def credentials(self) -> Credentials | None:
        """Those of the folder, if one is named; raises UserError where they are not there."""
        return credentials(self.security, (self.role or self.service,), self.robot) if self.security else None

    def effective(self) -> dict[str, Any]:
        """Every setting as it holds, plain types; not what belongs to this machine alone."""
        return self.model_dump(mode="json", exclude={"config", "print_config", "heartbeat"})

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,  # noqa: ARG003
        dotenv_settings: PydanticBaseSettingsSource,  # noqa: ARG003
        file_secret_settings: PydanticBaseSettingsSource,  # noqa: ARG003
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Command line (put first by pydantic) over arguments over environment over file."""
        # Only here is an empty value none at all (compose files pass such); on the command line '' says something.
        shared = EnvSettingsSource(settings_cls, env_ignore_empty=True)()
        own = EnvSettingsSource(settings_cls, env_prefix=f"PRESAGE_{cls.service.upper()}_", env_ignore_empty=True)()
        environment = {k: v for k, v in shared.items() if k not in cls.private}
        environment |= {k: v for k, v in own.items() if k in cls.private}
        file = InitSettingsSource(settings_cls, _file_values.get({}))
        return init_settings, InitSettingsSource(settings_cls, environment), file


def split_endpoints(text: str) -> tuple[str, ...]:
    """Comma-separated endpoints."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


def with_values_joined(argv: list[str]) -> list[str]:
    """``--start -3,1`` as ``--start=-3,1``: argparse takes a value that begins with a minus for an option."""
    joined: list[str] = []
    for word in argv:
        if re.match(r"-[.\d]", word) and joined and re.fullmatch(r"--[a-z][a-z-]*", joined[-1]):
            joined[-1] += f"={word}"
        else:
            joined.append(word)
    return joined


def load_settings(cls: type[S], argv: list[str] | None = None) -> S:
    """Settings of a service from all sources; raises UserError in one line. ``--print-config`` prints and ends."""
    argv = with_values_joined(sys.argv[1:] if argv is None else argv)
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    early.add_argument("--config", type=Path)
    path = early.parse_known_args(argv)[0].config
    values = _read_file(cls, path) if path else {}
    token = _file_values.set(values)
    try:
        source: CliSettingsSource[S] = CliSettingsSource(
            cls,
            cli_prog_name=cls.program or f"python -m services.{cls.service}",
            formatter_class=_Help,
        )
        settings = CliApp.run(cls, cli_args=argv, cli_settings_source=source)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(map(str, first["loc"])) or "settings"
        variable = f"PRESAGE_{cls.service.upper()}_{name.upper()}" if name in cls.private else f"PRESAGE_{name.upper()}"
        wrong = first["msg"]
        if first["type"] == "string_pattern_mismatch" and name in cls.model_fields:
            wrong = f"{first['input']!r} is not as it should be: {cls.model_fields[name].description}"
        raise UserError(
            f"{name}: {wrong} (--{name.replace('_', '-')}, {variable}{f' or {path}' if path else ''})"
        ) from None
    except SettingsError as error:
        raise UserError(" ".join(str(error).split())) from None
    finally:
        _file_values.reset(token)
    if settings.print_config:
        print(yaml.safe_dump({cls.service: settings.effective()}, sort_keys=False), end="")
        raise SystemExit(0)
    return settings


class _Help(argparse.RawDescriptionHelpFormatter):
    """The docstring's own lines, dedented."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return super()._fill_text(inspect.cleandoc(text), width, indent)


def _read_file(cls: type[ServiceSettings], path: Path) -> dict[str, Any]:
    """Top-level keys hold for every service that knows them, the section named after the service for it alone."""
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:  # a date like 2020-13-45, 20 000 brackets
        raise UserError(f"{path}: no YAML ({' '.join(str(error).split())})") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: a map of settings is expected")
    known = cls.model_fields.keys() - cls.private
    shared = {k: v for k, v in data.items() if not isinstance(v, dict) and k in known}
    section = data.get(cls.service) or {}
    if not isinstance(section, dict):
        raise UserError(f"{path}: {cls.service}: a map of settings is expected")
    return {**shared, **section}
