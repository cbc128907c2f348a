"""Options used by several commands."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from typer.core import TyperCommand, TyperGroup

from common.errors import UserError, similar_key
from common.robot.scanner import SCANNERS
from presage.terminal.settings_file import check_keys

# Rich assumes 80 columns when the output is not a terminal, which would wrap tables and long lines.
console = Console(width=None if sys.stdout.isatty() else 150)

# For commands whose result goes to standard output: progress and messages go to standard error.
err_console = Console(stderr=True, width=None if sys.stderr.isatty() else 150)

WorldName = Annotated[str, typer.Option(help="World name, world file, or ROS map.yaml.")]
EstimatorName = Annotated[str, typer.Option(help="Estimator preset: precise, paper, particle-filter or amcl-defaults.")]
ModelName = Annotated[
    str,
    typer.Option(
        help="Generative model of preset precise: learned, exact (computed from the world), a file of weights, or a"
        " folder of weights."
    ),
]
ScannerName = Annotated[
    str, typer.Option(help=f"Scanner model ({', '.join(SCANNERS)}) or a scanner file (docs/scanners.md).")
]
MountText = Annotated[str, typer.Option("--mount", help="Pose of the laser in base_link, x,y[,yaw_deg], in m and deg.")]
Config = Annotated[
    Path | None,
    typer.Option(
        help="YAML file of settings that have no option of their own (docs/settings.yaml).", callback=check_keys
    ),
]
Seed = Annotated[int | None, typer.Option(min=0, max=2**31, help="Random seed. Defaults to 0.")]
Json = Annotated[Path | None, typer.Option("--json", help="Also write the results to this JSON file.")]
OpenPage = Annotated[bool, typer.Option("--open", help="Open the live page in a browser, if there is one.")]


class GroupWithOptions(TyperGroup):
    """A group of commands; tells a user who gives one of its own options after the command where it stands."""

    def invoke(self, ctx: Any) -> Any:
        """Runs the command."""
        try:
            return super().invoke(ctx)
        except Exception as error:
            option = getattr(error, "option_name", None)
            own = {name for parameter in self.params for name in parameter.opts}
            if type(error).__name__ == "NoSuchOption" and option in own:  # typer does not export this class
                place = f"; it stands before the command: {ctx.command_path} {option} ... {ctx.invoked_subcommand}"
                error.message += place  # type: ignore[attr-defined]
            raise


class CommandWithNumbers(TyperCommand):
    """A command whose arguments may be negative numbers, such as -1, which are otherwise taken for options."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parses the command line. Raises UserError for an unknown option."""
        ctx.ignore_unknown_options = True
        root = ctx.find_root()
        program = root.command_path
        before = {name for parameter in root.command.params if not parameter.is_flag for name in parameter.opts}
        known = {name for parameter in self.get_params(ctx) for name in (*parameter.opts, *parameter.secondary_opts)}
        for word in args:
            name = word.split("=", maxsplit=1)[0]
            if name.startswith("--") and len(name) > 2 and name not in known:
                if name in before:
                    command = ctx.command_path.removeprefix(program)
                    raise UserError(f"{name} stands before the command, as in {program} {name} NAME{command}")
                similar = similar_key(name, known)
                hint = f"did you mean {similar}?" if similar else f"{ctx.command_path} --help lists all"
                raise UserError(f"{self.name} has no option {name}; {hint}")
        return super().parse_args(ctx, args)


def number(text: str) -> float:
    """Parses an argument that is a number."""
    try:
        return float(text)
    except ValueError:
        hint = "; separate numbers by spaces, as in 15 1.5" if "," in text else ""
        raise typer.BadParameter(f"{text!r} is not a number{hint}") from None


def given_options(**options: object) -> dict[str, object]:
    """The options that are neither None, empty nor False."""
    return {name: value for name, value in options.items() if value is not None and value != "" and value is not False}


def arguments(**options: object) -> list[str]:
    """Command-line arguments of a service for the options that are given."""
    names = {f"--{name.replace('_', '-')}": value for name, value in given_options(**options).items()}
    return [name if value is True else f"{name}={value}" for name, value in names.items()]


def model_setting(model: str) -> dict[str, object]:
    """The estimator's setting for `--model`: a folder is its setting ``models``, anything else ``model``."""
    return given_options(models=model) if model and Path(model).is_dir() else given_options(model=model)
