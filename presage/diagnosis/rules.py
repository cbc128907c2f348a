"""Turns observations into findings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from common.geometry import se2
from common.messages.definitions import Health, TopicHealth
from common.messages.requests import ConfigReply
from common.messages.topics import BELIEF, CMD_VEL, PREDICTION, SCAN, TOPICS, TRUTH, expected_rate, topic_of
from common.robot.scan_geometry import Sweep
from common.runtime.protocol_check import describe_version_differences, same_protocol
from common.runtime.service_monitor import REPLAY, REQUIRED_SERVICES, SUBSTITUTES
from common.runtime.session_files import is_left_out, session_of, start_command
from presage.diagnosis.bus_observation import BusObservation
from presage.diagnosis.findings import Finding
from presage.diagnosis.health_board import MIN_RATE_SHARE

MAX_CLOCK_DIFFERENCE_S = 0.5  # as long as the time-outs of the robot
MAX_DROPPED_SHARE = 0.1  # of the received messages; a service that drops more cannot keep up
MIN_STAMPED_S = 1.0  # scans of a shorter time do not show whether their stamps advance
MIN_SIMULATION_SPEED = 0.01  # times real time; stamps that advance more slowly are in another unit
MIN_STAMPED_BELIEFS = 5  # fewer may all belong to scans that came before the observation
MAY_SKIP_MESSAGES = {"viewer"}  # it shows only the newest messages
MAY_RUN_SEVERAL_TIMES = {"recorder", "viewer"}  # of the other services, only one instance is active (`Service.single`)


def evaluate_observation(observation: BusObservation, own_config: ConfigReply) -> Iterator[Finding]:
    """Yields all findings about the services of one robot; ``own_config`` holds the versions of this program."""
    yield from _presence(observation)
    yield from _duplicates(observation)
    yield from _versions(observation, own_config)
    yield from _worlds(observation)
    yield from _clocks(observation)
    yield from _rates(observation)
    yield from _scanner(observation)
    yield from _stamps(observation)
    yield from _counts(observation)


def _presence(observation: BusObservation) -> Iterator[Finding]:
    services = observation.monitor.services(observation.seconds)
    session = session_of(observation.robot, observation.connect)
    others = observation.robots - {observation.robot}
    if others and all(service.state == "absent" for service in services):
        what = (
            f"no service of robot {observation.robot!r} is running; there are services of {', '.join(sorted(others))}"
        )
        yield Finding("no_such_robot", False, what, observation.robot, "name the robot with --robot")
    for service in services:
        where, name = _where(observation, service.name), f"{service.name} of {observation.robot!r}"
        if _substitute(observation, service.name):
            continue
        if service.state == "absent":
            needed = service.name in observation.monitor.missing(observation.seconds)
            if not needed and is_left_out(service.name, observation.robot, session):
                continue
            advice = f"start it with: {start_command(service.name, observation.robot, observation.connect, session)}"
            yield Finding("missing", False if needed else None, f"{name}: not running", service.name, advice)
        elif service.state == "silent":
            advice = "see its log; resume it or restart it"
            yield Finding("frozen", False, f"{name}: {service.problem}", where, advice)
        elif service.problem:
            yield Finding("no_result", False, f"{name}: {service.problem}", where, "see its log")
        else:
            yield Finding("missing", True, f"{name}: alive", service.name)


def _substitute(observation: BusObservation, service: str) -> str:
    """Name of the service that runs in the place of one that does not run, or an empty text."""
    present, name = observation.monitor.present, SUBSTITUTES.get(service, "")
    return name if present(name, observation.seconds) and not present(service, observation.seconds) else ""


def _duplicates(observation: BusObservation) -> Iterator[Finding]:
    for service, replies in observation.replies.items():
        if len(replies) > 1 and service not in MAY_RUN_SEVERAL_TIMES:
            youngest = min(replies, key=lambda reply: reply.uptime)
            hosts = ", ".join(f"{reply.host or 'unknown host'} for {reply.uptime:.0f} s" for reply in replies)
            what = f"{service} of {observation.robot!r} runs {len(replies)} times: on {hosts}"
            yield Finding("doubled", False, what, hosts, f"stop all but one; the last was started on {youngest.host}")
    for key, numbers in observation.sequences.items():
        topic = topic_of(key)
        if topic is not None and numbers.restarts + numbers.reordered > 1:  # a single one is a restart of the publisher
            what = f"{key}: the sequence numbers go back and forth, because there are several publishers"
            advice = f"stop all publishers but one: probably a second {topic.publisher}, or a replay"
            yield Finding("two_publishers", False, what, key, advice)


def _versions(observation: BusObservation, own_config: ConfigReply) -> Iterator[Finding]:
    for service, replies in sorted(observation.replies.items()):
        for reply in replies:
            where = f"{service} on {reply.host or 'an unknown host'}"
            if not same_protocol(own_config, reply):
                what = f"{where}: protocol {reply.protocol}, but {own_config.protocol} here: messages will be misread"
                yield Finding("protocol", False, what, where, "install the same version of presage everywhere")
            if text := describe_version_differences(own_config, reply):
                advice = "install the same versions everywhere: `make install`, or the same image"
                yield Finding("versions", False, f"{where}: {text}", where, advice)


def _worlds(observation: BusObservation) -> Iterator[Finding]:
    """Compares the names of the services' worlds; the folders of a world file may differ between machines."""
    worlds: dict[str, list[str]] = {}
    for service in REQUIRED_SERVICES:
        for reply in observation.replies.get(service, []):
            # Empty while mapping: the controller plans in the map of the mapper.
            if world := _setting(reply, "world"):
                worlds.setdefault(Path(world).stem, []).append(service)
    if len(worlds) > 1:
        uses = "; ".join(f"{world}: {', '.join(services)}" for world, services in worlds.items())
        advice = "start the services with the same --world, else poses and walls do not agree"
        yield Finding("worlds", False, f"the services use different worlds ({uses})", observation.robot, advice)


def _clocks(observation: BusObservation) -> Iterator[Finding]:
    for service, health in sorted(observation.health.items()):
        # The difference contains the travel time of the message, which is positive: the smallest is the best estimate.
        difference = min(received - message.stamp_ns for received, message in health) * 1e-9
        if abs(difference) > MAX_CLOCK_DIFFERENCE_S:
            where = _where(observation, service)
            direction = "behind" if difference > 0 else "ahead of"
            what = f"{where}: its clock is {abs(difference):.1f} s {direction} this machine's"
            advice = (
                f"synchronise both clocks with NTP; more than {MAX_CLOCK_DIFFERENCE_S:g} s spoils latencies and logs"
            )
            yield Finding("clocks", False, what, where, advice)


def _rates(observation: BusObservation) -> Iterator[Finding]:
    # A real robot's scanner may have any rate, and there is no ground truth.
    real_robot = bool(_substitute(observation, "simulator"))
    period = observation.scan.scan_time if observation.scan is not None else 0.0
    if real_robot and not period and (scans := observation.arrivals[SCAN.key(observation.robot)]):
        period = observation.seconds / scans  # some drivers do not fill in scan_time
    for topic in TOPICS:
        if not topic.rate or topic.per_service or (real_robot and topic is TRUTH):
            continue
        key = topic.key(observation.robot)
        rate = observation.arrivals[key] / observation.seconds
        expected = expected_rate(topic, period)
        ok = rate > 0 and rate >= MIN_RATE_SHARE * expected
        if topic is PREDICTION and not rate and observation.arrivals[BELIEF.key(observation.robot)]:
            yield Finding("rate", None, "prediction: none, which is right for an estimator that predicts no scans", key)
            continue
        publisher = _substitute(observation, topic.publisher) or topic.publisher
        advice = f"published by the {publisher}: is it alive, paused, or are its inputs missing? See its log"
        if topic is CMD_VEL and rate > 1.5 * expected:
            ok, advice = False, "there may be several controllers: stop all but one"
        yield Finding("rate", ok, f"{topic.name}: {rate:.1f} of {expected:.3g} Hz", key, "" if ok else advice)
    for key, error in sorted(observation.undecodable.items()):
        advice = "another program or another version publishes there; `presage echo` shows the messages"
        yield Finding("undecodable", False, f"{key}: {error}", key, advice)


def _scanner(observation: BusObservation) -> Iterator[Finding]:
    """Describes the scanner's beams and mount, and checks that they are usable for driving."""
    if (scan := observation.scan) is None:
        return
    sweep, mount = Sweep.of(scan), scan.mount
    view = sweep.sector(mount.yaw)
    first, increment, yaw = np.rad2deg([sweep.first, sweep.increment, mount.yaw])
    what = (
        f"scanner: {sweep.beams} beams from {first:.4g} deg on, {increment:.3g} deg apart, "
        f"mounted at ({mount.x:g}, {mount.y:g}) m, {yaw:.4g} deg"
        f"{', clockwise as if upside down' if sweep.increment < 0 else ''}"
    )
    where = SCAN.key(observation.robot)
    if sweep.spacing * (sweep.beams - 1) > np.deg2rad(360.1):
        advice = "the beams cover more than one turn: angle_increment must be wrong"
        yield Finding("scanner", False, what, where, advice)
    elif abs(se2.wrap(-view.centre)) > view.half:
        advice = "no beam points ahead; correct the yaw of `mount` if that is wrong (docs/scanners.md)"
        yield Finding("scanner", None, what, where, advice)
    else:
        yield Finding("scanner", True, what, where)


def _stamps(observation: BusObservation) -> Iterator[Finding]:
    """Checks that stamps of scans advance with time, and that beliefs have the stamps of scans."""
    arrivals, stamps = np.array(observation.scan_stamps, np.int64).reshape(-1, 2).T
    passed = float(np.ptp(arrivals)) * 1e-9 if len(arrivals) else 0.0
    if passed >= MIN_STAMPED_S and not _time_may_stand(observation):
        advance = float(np.maximum(np.diff(stamps), 0).sum()) * 1e-9
        ok = advance >= MIN_SIMULATION_SPEED * passed
        text = "advance with time" if ok else "do not advance with time"
        what = f"scans: their stamps {text} ({advance:.3g} s in {passed:.3g} s)"
        yield Finding("stamps", ok, what, SCAN.key(observation.robot), "" if ok else "stamp_ns is in nanoseconds")
    if len(stamps) and len(observation.belief_stamps) >= MIN_STAMPED_BELIEFS:
        matched = int(np.isin(observation.belief_stamps, stamps).sum())
        ok = matched > len(observation.belief_stamps) / 2
        what = f"beliefs: {matched} of {len(observation.belief_stamps)} have the stamp of a scan"
        advice = "" if ok else "a belief has the stamp_ns of the scan that it follows from; others are taken for old"
        yield Finding("stamps", ok, what, BELIEF.key(observation.robot), advice)


def _time_may_stand(observation: BusObservation) -> bool:
    """Whether the stamps of scans may rightly stand still: in a replay, and in lockstep."""
    lockstep = any(_setting(reply, "pace") == "lockstep" for reply in observation.replies.get("simulator", []))
    return lockstep or observation.monitor.present(REPLAY, observation.seconds)


def _setting(reply: ConfigReply, name: str) -> str:
    """A setting of a service; empty if its reply, as that of another program, has none."""
    try:
        config = json.loads(reply.config)
    except ValueError:
        return ""
    return str(config.get(name, "")) if isinstance(config, dict) else ""


def _counts(observation: BusObservation) -> Iterator[Finding]:
    for service, health in sorted(observation.health.items()):
        by_instance: dict[str, list[Health]] = {}
        for _, message in health:
            by_instance.setdefault(message.instance, []).append(message)
        # The recorder that `presage up` keeps ready is idle while `presage record` records.
        active = [each for each in by_instance.values() if not each[-1].idle]
        for messages in active or by_instance.values():
            yield from _counts_of_instance(service, messages[0], messages[-1])


def _counts_of_instance(service: str, first: Health, last: Health) -> Iterator[Finding]:
    if last.note:
        unfit = _increase(first, last, "unfit_scans") > 0
        yield Finding(
            "weights" if unfit else "note", False if unfit else None, f"{service} reports: {last.note}", service
        )
    if (failed := _increase(first, last, "failed")) > 0:
        what = f"{service}: {failed} steps failed during the observation"
        yield Finding("failed", False, what, service, "its log contains the traceback")
    before = {row.key: row for row in first.topics}
    for row in last.topics:
        yield from _counts_of_key(service, before.get(row.key, TopicHealth(key=row.key)), row)


def _counts_of_key(service: str, before: TopicHealth, row: TopicHealth) -> Iterator[Finding]:
    received, dropped = row.received - before.received, row.dropped - before.dropped
    if (bad := row.undecodable - before.undecodable) > 0:
        what = f"{service}: {bad} payloads on {row.key} could not be decoded during the observation"
        advice = f"another program or another version publishes there; see the log of the {service}"
        yield Finding("undecodable_rising", False, what, row.key, advice)
    if dropped > 0 and service not in MAY_SKIP_MESSAGES:
        too_many = dropped > MAX_DROPPED_SHARE * max(received, 1)
        what = f"{service}: {dropped} of {received} messages on {row.key} were dropped during the observation"
        advice = "the service is too slow for its input: try a smaller --beams, another estimator, or a faster machine"
        yield Finding("dropped_rising", False if too_many else None, what, row.key, advice if too_many else "")


def _increase(first: Health, last: Health, name: str) -> int:
    return last.counters.get(name, 0) - first.counters.get(name, 0)


def _where(observation: BusObservation, service: str) -> str:
    hosts = sorted({reply.host for reply in observation.replies.get(service, []) if reply.host})
    return f"{service} on {', '.join(hosts)}" if hosts else service
