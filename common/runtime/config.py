"""Settings from defaults, a YAML file, the environment and the command line.

Each service has one settings class. Environment variables, command-line options and their help are derived from its
fields. The command `presage` passes its options on to these classes as arguments. It uses typer for its sub-commands;
services have none, so a container of one service needs no typer.
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
from pydantic import BaseModel, Field, ValidationError
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
from common.bus.security import Credentials, read_credentials
from common.errors import UserError, first_fault, first_problem, similar_key
from common.messages.topics import ROBOT_NAME_PATTERN
from common.names import split_names
from common.yaml_text import NOT_YAML, parse_yaml

_file_values: ContextVar[dict[str, Any]] = ContextVar("_file_values")
S = TypeVar("S", bound="ServiceSettings")
M = TypeVar("M", bound=BaseModel)
METRICS_PATTERN = r"^$|^(\[[0-9A-Fa-f:.]+\]:|[^\s:\[\]]+:)?\d{1,5}$"  # PORT, HOST:PORT, [IPv6]:PORT, or empty


class ServiceSettings(BaseSettings):
    """Settings that every service has."""

    model_config = SettingsConfigDict(
        env_prefix="PRESAGE_",
        extra="forbid",
        frozen=True,
        cli_kebab_case=True,
        cli_implicit_flags=True,
        cli_hide_none_type=True,
    )
    service: ClassVar[str] = "service"
    program: ClassVar[str] = ""  # shown in --help; if empty, python -m services.NAME
    # Fields that are set only for this service: by PRESAGE_<SERVICE>_<FIELD> or in its section of the file. All other
    # fields can also be set for all services, by PRESAGE_<FIELD> or at the top level of the file.
    private: ClassVar[frozenset[str]] = frozenset()

    robot: Annotated[
        str,
        Field(
            pattern=rf"^{ROBOT_NAME_PATTERN}$",
            description="name of the robot: the topics are presage/ROBOT/TOPIC",
        ),
    ] = "robot"
    connect: Annotated[
        str, Field(description="zenoh endpoints to connect to, comma-separated; empty for no connection")
    ] = DEFAULT_ENDPOINT
    listen: Annotated[
        str, Field(description="zenoh endpoints to listen on, comma-separated; by default only on loopback")
    ] = "tcp/127.0.0.1:0"
    lossless: Annotated[
        bool,
        Field(description="wait for slow subscribers instead of dropping messages; for replays, not for a robot"),
    ] = False
    security: Annotated[
        Path | None, Field(description="folder with credentials from `presage secure init`; enables TLS and roles")
    ] = None
    role: Annotated[
        str, Field(description="name of the credentials in that folder; defaults to the name of the service")
    ] = ""
    insecure: Annotated[
        bool, Field(description="allow listening on other addresses than loopback without --security")
    ] = False
    log_level: Annotated[
        str, Field(pattern="^(debug|info|warning|error)$", description="debug, info, warning, error")
    ] = "info"
    log_json: Annotated[bool, Field(description="write log lines as JSON")] = False
    metrics: Annotated[
        str,
        Field(
            pattern=METRICS_PATTERN,
            description="PORT or HOST:PORT of the Prometheus endpoint, 0 for any free port; empty for no endpoint",
        ),
    ] = ""
    heartbeat: Annotated[
        Path | None,
        Field(description="folder for a status file that is written each second, for health checks; default: no file"),
    ] = None
    config: Annotated[Path | None, Field(description="YAML file of settings, with a section for each service")] = None
    print_config: Annotated[bool, Field(description="print the effective settings as YAML and exit")] = False

    def link(self) -> Link:
        """Parameters of the zenoh session; raises UserError if the credentials cannot be read."""
        return Link(
            self.robot,
            tuple(split_names(self.connect)),
            tuple(split_names(self.listen)),
            lossless=self.lossless,
            security=self.credentials(),
            insecure=self.insecure,
        )

    def credentials(self) -> Credentials | None:
        """Credentials from the folder ``security``, or None if it is not set; raises UserError if they are missing."""
        return read_credentials(self.security, (self.role or self.service,), self.robot) if self.security else None

    def effective(self) -> dict[str, Any]:
        """Values of all settings as plain types, without those that only matter on this machine."""
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
        """Precedence: command line (which pydantic puts first), constructor arguments, environment, file."""
        # Compose files pass unset variables as empty ones, so these are ignored. On the command line '' is a value.
        shared = EnvSettingsSource(settings_cls, env_ignore_empty=True)()
        own = EnvSettingsSource(settings_cls, env_prefix=f"PRESAGE_{cls.service.upper()}_", env_ignore_empty=True)()
        environment = {k: v for k, v in shared.items() if k not in cls.private}
        environment |= own
        file = InitSettingsSource(settings_cls, _file_values.get({}))
        return init_settings, InitSettingsSource(settings_cls, environment), file


def join_negative_values(argv: list[str]) -> list[str]:
    """Writes ``--start -3,1`` as ``--start=-3,1``: argparse takes a word that begins with a minus as an option."""
    joined: list[str] = []
    for argument in argv:
        if re.match(r"-[.\d]", argument) and joined and re.fullmatch(r"--[a-z][a-z-]*", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def load_settings(cls: type[S], argv: list[str] | None = None) -> S:
    """Loads the settings of a service from all sources.

    ``argv`` defaults to the arguments of the process. With ``--print-config``, prints the settings and exits. Raises
    UserError for an invalid setting or file.
    """
    argv = join_negative_values(sys.argv[1:] if argv is None else argv)
    config_parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    config_parser.add_argument("--config", type=Path)
    path = config_parser.parse_known_args(argv)[0].config
    values = _read_file(cls, path) if path else {}
    token = _file_values.set(values)
    try:
        source: CliSettingsSource[S] = CliSettingsSource(
            cls,
            cli_prog_name=cls.program or f"python -m services.{cls.service}",
            formatter_class=_HelpFormatter,
        )
        settings = CliApp.run(cls, cli_args=argv, cli_settings_source=source)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        name = ".".join(map(str, first["loc"])) or "settings"
        variable = f"PRESAGE_{cls.service.upper()}_{name.upper()}" if name in cls.private else f"PRESAGE_{name.upper()}"
        problem = first_problem(error)
        if first["type"] == "extra_forbidden":
            similar = similar_key(name, cls.model_fields)
            problem += f"; did you mean {similar}?" if similar else ""
        if first["type"] == "string_pattern_mismatch" and name in cls.model_fields:
            problem = f"{first['input']!r} is not valid; expected: {cls.model_fields[name].description}"
        raise UserError(
            f"{name}: {problem} (--{name.replace('_', '-')}, {variable}{f' or {path}' if path else ''})"
        ) from None
    except SettingsError as error:
        raise UserError(" ".join(str(error).split())) from None
    finally:
        _file_values.reset(token)
    if settings.print_config:
        print(yaml.safe_dump({cls.service: settings.effective()}, sort_keys=False), end="")
        raise SystemExit(0)
    return settings


class _HelpFormatter(argparse.RawDescriptionHelpFormatter):
    """Shows the docstring of the settings class with its own line breaks."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return super()._fill_text(inspect.cleandoc(text), width, indent)


def _read_file(cls: type[ServiceSettings], path: Path) -> dict[str, Any]:
    """Reads one service's settings: top-level keys apply to all services, the section of a service only to it."""
    data = read_settings_file(path)
    known = cls.model_fields.keys() - cls.private
    shared = {k: v for k, v in data.items() if not isinstance(v, dict) and k in known}
    return {**shared, **read_section(path, cls.service)}


def read_section(path: Path, name: str) -> dict[str, Any]:
    """The section ``name`` of a settings file, empty if there is none; raises UserError if the file is invalid."""
    section = read_settings_file(path).get(name) or {}
    if not isinstance(section, dict):
        raise UserError(f"{path}: {name}: expected a mapping of settings")
    return section


def load_section(cls: type[M], path: Path | None, name: str, **options: object) -> M:
    """Loads the section ``name`` of a settings file as ``cls``; ``options`` that are not empty take precedence.

    Raises UserError if a setting is unknown or invalid.
    """
    section = {} if path is None else read_section(path, name)
    try:
        return cls.model_validate({**section, **{key: value for key, value in options.items() if value}})
    except ValidationError as error:
        raise UserError(f"{path or 'options'}: {first_fault(error)} (section {name})") from None


def read_settings_file(path: Path) -> dict[str, Any]:
    """All keys of a settings file; raises UserError if it is invalid."""
    try:
        data = parse_yaml(path.read_text(encoding="utf-8")) or {}
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror})") from None
    except NOT_YAML as error:
        raise UserError(f"{path}: not valid YAML ({' '.join(str(error).split())})") from None
    if not isinstance(data, dict):
        raise UserError(f"{path}: expected a mapping of settings")
    return data
