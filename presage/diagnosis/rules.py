"""Turns observations into findings."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from common.geometry import se2
from common.messages.definitions import Health, TopicHealth
from common.messages.requests import ConfigReply
from common.messages.topics import CMD_VEL, SCAN, TOPICS, TRUTH, expected_rate, topic_of
from common.robot.scan_geometry import Sweep
from common.runtime.protocol_check import describe_version_differences, same_protocol
from presage.diagnosis.bus_observation import Observed
from presage.diagnosis.findings import Finding
from presage.diagnosis.health_board import SLOW, SOURCE, STANDS_IN, replaced
from presage.diagnosis.installation import NEEDED

OPTIONAL = {"recorder": "needed only to record, with"}  # a healthy session can do without
NO_PULSE = {SOURCE}  # alive, and publishes no health
SILENT = 2.5  # s without a pulse, of which one comes each second
CLOCKS = 0.5  # s between two hosts' clocks; the robot's own time-outs are as long
DROPPED = 0.1  # of what came; more is falling behind
LOOKS_ON = {"viewer"}  # a frame that it skips is lost to nobody


def judge(seen: Observed, mine: ConfigReply) -> Iterator[Finding]:
    """All findings about the services of one robot; ``mine`` is what this tool would say of itself."""
    yield from _presence(seen)
    yield from _doubled(seen)
    yield from _versions(seen, mine)
    yield from _clocks(seen)
    yield from _rates(seen)
    yield from _scanner(seen)
    yield from _counts(seen)


def _presence(seen: Observed) -> Iterator[Finding]:
    others = seen.robots - {seen.robot}
    if not seen.alive and others:
        what = f"nobody is {seen.robot!r}; there are {', '.join(sorted(others))}"
        yield Finding("no_such_robot", False, what, seen.robot, "name the robot with --robot")
    for service in NEEDED:
        there, source = service in seen.alive, replaced(service, seen.alive)
        what = f"{service} of {seen.robot!r}: {'alive' if there else 'not there'}"
        advice = "" if there else f"{OPTIONAL.get(service, 'start it with')}: python -m services.{service}"
        yield Finding("missing", there or (None if service in OPTIONAL or source else False), what, service, advice)
    for service in sorted(seen.alive - NO_PULSE):
        if service not in seen.pulses and seen.seconds >= SILENT:
            what = (
                f"{service}: alive, but no pulse came within {seen.seconds:g} s: it is frozen, or in a step without end"
            )
            yield Finding("frozen", False, what, _where(seen, service), "see its log; continue it or start it again")


def _doubled(seen: Observed) -> Iterator[Finding]:
    for service, replies in seen.replies.items():
        if len(replies) > 1:
            youngest = min(replies, key=lambda reply: reply.uptime)
            hosts = ", ".join(f"{reply.host or 'unknown host'} for {reply.uptime:.0f} s" for reply in replies)
            what = f"{service} of {seen.robot!r} runs {len(replies)} times: on {hosts}"
            yield Finding("doubled", False, what, hosts, f"stop all but one; the last came on {youngest.host}")
    for key, numbers in seen.sequences.items():
        topic = topic_of(key)
        if topic is not None and numbers.restarts + numbers.reordered > 1:  # one alone is a publisher that began anew
            what = f"{key}: numbers go back and forth, more than one publishes there"
            yield Finding("two_publishers", False, what, key, f"from a second {topic.publisher}, or a replay: stop one")


def _versions(seen: Observed, mine: ConfigReply) -> Iterator[Finding]:
    for service, replies in sorted(seen.replies.items()):
        for reply in replies:
            where = f"{service} on {reply.host or 'an unknown host'}"
            if not same_protocol(mine, reply):
                what = f"{where}: protocol {reply.protocol}, {mine.protocol} here: they misread each other's messages"
                yield Finding("protocol", False, what, where, "install the same version of presage everywhere")
            if text := describe_version_differences(mine, reply):
                advice = "install the same versions everywhere: `make install`, or the same image"
                yield Finding("versions", False, f"{where}: {text}", where, advice)


def _clocks(seen: Observed) -> Iterator[Finding]:
    for service, pulses in sorted(seen.pulses.items()):
        # A pulse takes its time to come, never less than none: the quickest tells most.
        apart = min(received - health.stamp_ns for received, health in pulses) * 1e-9
        if abs(apart) > CLOCKS:
            where = _where(seen, service)
            what = f"{where}: its clock is {abs(apart):.1f} s {'behind' if apart > 0 else 'ahead of'} this machine's"
            advice = f"set both by NTP; up to {CLOCKS:g} s is let pass, more spoils latencies and logs"
            yield Finding("clocks", False, what, where, advice)


def _rates(seen: Observed) -> Iterator[Finding]:
    foreign = STANDS_IN["simulator"] in seen.alive  # a real scanner has a rate of its own, and nobody knows the truth
    period = seen.scan.scan_time if seen.scan is not None else 0.0
    if foreign and not period and (scans := seen.arrivals[SCAN.key(seen.robot)]):
        period = seen.seconds / scans  # drivers may leave it out
    for topic in TOPICS:
        if not topic.rate or topic.per_service or (foreign and topic is TRUTH):
            continue
        key = topic.key(seen.robot)
        rate = seen.arrivals[key] / seen.seconds
        meant = expected_rate(topic, period)
        ok = rate > 0 and rate >= SLOW * meant
        advice = f"from the {topic.publisher}: is it alive, paused, or are its inputs missing? see its log"
        if topic is CMD_VEL and rate > 1.5 * meant:
            ok, advice = False, "more than one driver? stop all controllers but one"
        yield Finding("rate", ok, f"{topic.name}: {rate:.1f} of {meant:.3g} Hz", key, "" if ok else advice)
    for key, why in sorted(seen.undecodable.items()):
        advice = "another program or another version publishes there; `presage echo` shows what comes"
        yield Finding("undecodable", False, f"{key}: {why}", key, advice)


def _scanner(seen: Observed) -> Iterator[Finding]:
    """What it looks at, and whether that serves to drive."""
    if (scan := seen.scan) is None:
        return
    sweep, mount = Sweep.of(scan), scan.mount
    view = sweep.sector(mount.yaw)
    first, apart, turned = np.rad2deg([sweep.first, sweep.increment, mount.yaw])
    what = (
        f"scanner: {sweep.beams} beams from {first:.4g} deg on, {apart:.3g} deg apart, "
        f"mounted at ({mount.x:g}, {mount.y:g}) m, {turned:.4g} deg"
        f"{', clockwise, as upside down' if sweep.increment < 0 else ''}"
    )
    where = SCAN.key(seen.robot)
    if sweep.spacing * (sweep.beams - 1) > np.deg2rad(360.1):
        yield Finding("scanner", False, what, where, "its beams go round more than once: angle_increment is not that")
    elif not sweep.increment or sweep.beams < 2:
        yield Finding(
            "scanner", False, what, where, "its beams have no directions: angle_increment is 0, or there is but one"
        )
    elif abs(se2.wrap(-view.centre)) > view.half:
        yield Finding(
            "scanner", None, what, where, "it does not look ahead: turn `mount` if that is wrong (docs/scanners.md)"
        )
    else:
        yield Finding("scanner", True, what, where)


def _counts(seen: Observed) -> Iterator[Finding]:
    for service, pulses in sorted(seen.pulses.items()):
        first, last = pulses[0][1], pulses[-1][1]
        if last.note:
            unfit = _rose(first, last, "unfit_scans") > 0
            yield Finding(
                "weights" if unfit else "note", False if unfit else None, f"{service} says: {last.note}", service
            )
        if (failed := _rose(first, last, "failed")) > 0:
            what = f"{service}: {failed} steps failed while we listened"
            yield Finding("failed", False, what, service, "its log has the traceback")
        before = {row.key: row for row in first.topics}
        for row in last.topics:
            yield from _of_key(service, before.get(row.key, TopicHealth(key=row.key)), row)


def _of_key(service: str, before: TopicHealth, row: TopicHealth) -> Iterator[Finding]:
    received, dropped = row.received - before.received, row.dropped - before.dropped
    if (bad := row.undecodable - before.undecodable) > 0:
        what = f"{service}: {bad} payloads on {row.key} could not be decoded while we listened"
        advice = "another program or another version publishes there; its log says what is wrong with them"
        yield Finding("undecodable_rising", False, what, row.key, advice)
    if dropped > 0 and service not in LOOKS_ON:
        much = dropped > DROPPED * max(received, 1)
        what = f"{service}: {dropped} of {received} messages on {row.key} not used while we listened"
        advice = "it is too slow for what comes: a smaller --beams, another estimator, or a faster machine"
        yield Finding("dropped_rising", False if much else None, what, row.key, advice if much else "")


def _rose(first: Health, last: Health, name: str) -> int:
    return last.counters.get(name, 0) - first.counters.get(name, 0)


def _where(seen: Observed, service: str) -> str:
    hosts = sorted({reply.host for reply in seen.replies.get(service, []) if reply.host})
    return f"{service} on {', '.join(hosts)}" if hosts else service
