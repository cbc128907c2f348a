"""`presage topics`, `hz`, `echo`, `top` and `doctor`."""

from __future__ import annotations

from typing import Annotated

import typer

from common.bus.bus import Link
from presage.cli.session_options import chosen_link
from presage.session.running_sessions import OBSERVER, check_robot_name, find_session
from presage.terminal.options import Json, WorldName, console

app = typer.Typer()


@app.command(rich_help_panel="Diagnose", short_help="Print the table of topics and queryables.")
def topics() -> None:
    """Print the table of topics and queryables.

    Example: `presage topics`.
    """
    from presage.live.commands import list_topics

    list_topics("ROBOT", console)


@app.command(rich_help_panel="Diagnose", short_help="Measure message rates on the bus.")
def hz(
    context: typer.Context,
    topic: Annotated[str | None, typer.Argument(help="Topic to measure. Defaults to all topics.")] = None,
    seconds: Annotated[float, typer.Option(min=0.1, help="Duration of the measurement, s.")] = 3.0,
) -> None:
    """Measure the message rates on the bus.

    Examples: `presage hz`; `presage hz scan --seconds 10`.
    """
    from presage.live.commands import show_rates

    show_rates(chosen_link(context, OBSERVER), topic, seconds, console)


@app.command(rich_help_panel="Diagnose", short_help="Health of every service, until Ctrl-C.")
def top(
    context: typer.Context,
    robots: Annotated[list[str] | None, typer.Argument(help="Robots. Defaults to all of the session.")] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Print one table and exit, with status 1 if a service is missing.")
    ] = False,
) -> None:
    """Show the health of every service until Ctrl-C: rates, latency, drops, missing services and how to start them.

    Examples: `presage top`; `presage top --once`; `presage top one two`.
    """
    from presage.diagnosis.top import run_top

    chosen = context.find_root().params
    shown = robots or [name for name in (chosen["robot"],) if name] or find_session(chosen["connect"]).robots
    for name in shown:
        check_robot_name(name)
    link = chosen_link(context, OBSERVER, shown[0])
    raise typer.Exit(run_top(link, list(dict.fromkeys(shown)), console, once=once))


@app.command(rich_help_panel="Diagnose", short_help="Find problems of the installation and the session.")
def doctor(
    context: typer.Context,
    seconds: Annotated[
        float,
        typer.Option(
            min=0.5,
            help="How long to observe the bus, s. Detecting a frozen service takes at least 2.5 s.",
        ),
    ] = 3.0,
    world: WorldName = "corridor",
    json_file: Json = None,
) -> None:
    """Check the installation, this machine and the running session for problems.

    Exits with status 1 if there is a problem.

    Examples: `presage doctor`; `presage doctor --seconds 10 --json findings.json`; `presage doctor --world my.yaml`;
    `presage --connect tcp/192.168.0.10:7447 --robot two doctor`.
    """
    from common.runtime.config import load_settings
    from presage.diagnosis.doctor import run_doctor
    from services.recorder.settings import RecorderSettings

    link, recordings = chosen_link(context, OBSERVER), load_settings(RecorderSettings, []).directory
    raise typer.Exit(run_doctor(link, seconds, console, world=world, recordings=recordings, json_file=json_file))


@app.command(rich_help_panel="Diagnose", short_help="Print messages of a topic or a recording as JSON.")
def echo(
    context: typer.Context,
    source: Annotated[str, typer.Argument(help="A topic on the bus, or a recording.", metavar="TOPIC|FILE")],
    topic: Annotated[
        str | None, typer.Argument(help="Topic or key of the recording to print. Defaults to all topics.")
    ] = None,
    count: Annotated[
        int,
        typer.Option("-n", "--count", min=0, help="Stop after this many messages. 0 prints until the end or Ctrl-C."),
    ] = 0,
    start: Annotated[
        float, typer.Option(min=0.0, help="Skip this many seconds at the beginning of the recording.")
    ] = 0.0,
    full: Annotated[bool, typer.Option("--full", help="Print long arrays completely.")] = False,
) -> None:
    """Print messages as JSON lines, either live from a topic, or from a recording with their keys and times.

    The name of a topic reads from the bus; anything else is a file name (./belief is a file, belief is a topic).

    Examples: `presage echo belief -n 1`; `presage echo scan --full -n 1 | jq .ranges`;
    `presage echo run.mcap`; `presage echo run.mcap belief -n 3 --start 10`;
    `presage echo run.mcap belief | jq .free_energy`.
    """
    from presage.recordings.printing import echo_either

    def link() -> Link:  # a recording needs no session
        return chosen_link(context, OBSERVER)

    raise typer.Exit(echo_either(link, source, topic, count, start, console, full=full))
