"""Which commands are passed on, and when the robot is stopped."""

from __future__ import annotations

import numpy as np
import pytest

from common.messages.definitions import CmdVel, Scan, Twist
from common.robot.robot import Robot
from services.bridge_ros2.command_gate import STOP_REPEAT_S, CommandGate

MS = 10**6


def scan(stamp_ms, ahead=np.inf):
    ranges = np.full(3, ahead, np.float32)
    return Scan(
        stamp_ns=stamp_ms * MS, angle_min=-0.1, angle_increment=0.1, range_min=0.0, range_max=10.0, ranges=ranges
    )


def command(stamp_ms, vx=0.5, wz=0.0):
    return CmdVel(stamp_ns=stamp_ms * MS, twist=Twist(vx=vx, wz=wz))


def driving(at=0.0, stamp_ms=1000, **more):
    gate = CommandGate(Robot(), **more)
    gate.add_scan(scan(stamp_ms), at)
    return gate


def test_fresh_and_old_commands():
    gate = driving()
    np.testing.assert_array_equal(gate.command(command(1000), 0.01), [0.5, 0, 0])
    gate.add_scan(scan(1066), 0.066)
    assert gate.command(command(400), 0.07) is None  # before the last command's stamp, and too old
    assert gate.command(command(2000), 0.07) is None  # newer than the newest scan
    assert gate.refused == 2
    assert gate.command(command(1066), 0.07) is not None
    gate.add_scan(scan(1700), 0.7)
    assert gate.command(command(1100), 0.71) is None  # answers a scan 0.6 s old
    gate = driving()
    assert gate.command(command(1000), 0.6) is None  # the newest scan is 0.6 s old itself
    assert CommandGate(Robot()).command(command(0), 0.0) is None  # no scan at all


def test_stop_when_commands_end():
    gate = driving()
    assert not gate.moving
    gate.command(command(1000), 0.0)
    assert gate.moving
    assert gate.due(0.1) == pytest.approx(0.1)
    np.testing.assert_array_equal(gate.stop_for_silence(0.2), np.zeros(3))
    assert gate.stop_for_silence(0.2) is None


def test_repeated_stop():
    gate = driving()
    gate.command(command(1000), 0.0)
    gate.stop_for_silence(0.2)
    stops = [now for now in np.arange(0.2, 1.2, 0.05).tolist() if gate.repeat_stop(now) is not None]
    assert 4 <= len(stops) <= STOP_REPEAT_S / 0.1
    assert max(stops) <= 0.2 + STOP_REPEAT_S + 1e-9
    assert gate.repeat_due(1.2) is None
    gate.add_scan(scan(1300), 1.3)
    gate.command(command(1300), 1.3)
    gate.stop_for_silence(1.5)
    gate.add_scan(scan(1600), 1.6)
    assert gate.command(command(1600), 1.6) is not None
    assert gate.repeat_stop(1.7) is None


def test_gap_between_scans():
    gate = driving()
    for stamp in (1100, 1200, 1300, 2200, 2300):  # 10 Hz, 0.9 s missing
        gate.add_scan(scan(stamp), stamp * 1e-3 - 1)
        assert gate.timeout == pytest.approx(0.2)


def test_repeated_command():
    gate = driving()
    gate.command(command(1000), 0.0)
    np.testing.assert_array_equal(gate.command(command(1000), 0.15), [0.5, 0, 0])
    assert gate.due(0.15) == pytest.approx(0.05)
    np.testing.assert_array_equal(gate.command(command(1000), 0.25), np.zeros(3))
    assert gate.command(command(1000), 0.3) is None


def test_slow_scanner():
    gate = driving()
    gate.add_scan(scan(1200), 0.2)  # 5 Hz
    assert gate.timeout == pytest.approx(0.3)


def test_standing_robot():
    gate = driving()
    assert gate.command(command(1000, vx=0.0), 0.0) is None  # the robot has not moved
    gate.add_scan(scan(1066), 0.066)
    gate.command(command(1066), 0.07)
    repeated = []
    for k in range(2, 12):
        stamp, now = 1000 + 66 * k, 0.066 * k
        gate.add_scan(scan(stamp), now)
        repeated.append((now, gate.command(command(stamp, vx=0.0), now) is not None))
    assert [sent for now, sent in repeated] == [now - 0.07 <= STOP_REPEAT_S for now, _ in repeated]
    assert repeated[0][1]
    assert not repeated[-1][1]
    assert not gate.moving


def test_limits_and_obstacle_stop():
    gate = CommandGate(Robot(drive="differential", max_speed=0.3))
    gate.add_scan(scan(1000), 0.0)
    np.testing.assert_allclose(gate.command(command(1000, vx=5.0, wz=9.0), 0.0), [0.3, 0, 2.0])
    near = CommandGate(Robot())
    near.add_scan(scan(1000, ahead=0.28), 0.0)
    assert near.command(command(1000, vx=1.0), 0.0) is None  # no stop is sent to a standing robot
    assert near.stopped
    blind = CommandGate(Robot(), obstacle_stop=False)
    blind.add_scan(scan(1000, ahead=0.28), 0.0)
    assert blind.command(command(1000, vx=1.0), 0.0)[0] == 1.0


def test_time_set_back():
    gate = driving(stamp_ms=9000)
    gate.command(command(9000), 0.0)
    gate.add_scan(scan(100), 0.1)
    assert gate.command(command(100), 0.1) is not None


@pytest.mark.parametrize("rate", [40, 15, 10, 5])
@pytest.mark.parametrize("gap", [0.6, 0.4, 0.2])
def test_commands_end_before_a_wall(rate, gap):
    """The robot drives at a wall, and no command comes any more from ``gap`` m on; it brakes as gently as it states."""
    robot, step_s, pipeline_s = Robot(), 1e-3, 0.02
    gate, x, speed, wanted, wall = CommandGate(robot), 0.0, 0.0, 0.0, 3.0
    for k in range(10_000):
        now = k * step_s
        gate.add_velocity(np.array([speed, 0, 0]), now)
        if k % (1000 // rate) == 0:
            gate.add_scan(scan(k, ahead=wall - x), now)
            scanned = k
        if now == pytest.approx(scanned * step_s + pipeline_s) and wall - x - robot.radius > gap:
            sent = gate.command(command(scanned, vx=1.0), now)
            wanted = wanted if sent is None else sent[0]
        if gate.moving and gate.due(now) <= 0 and gate.stop_for_silence(now) is not None:
            wanted = 0.0
        speed += np.clip(wanted - speed, -robot.acceleration * step_s, robot.acceleration * step_s)
        x += speed * step_s
    assert speed == 0.0
    assert 0.0 < wall - x - robot.radius < gap


def test_simulation_slower_than_real_time():
    """Commands come at the rate of the scans, which is lower than their stamps say."""
    gate = driving()
    for k in range(1, 20):
        now = k / 5 / 0.6  # 5 Hz of simulated time
        assert k < 3 or gate.due(now) > 0
        gate.add_scan(scan(1000 + 200 * k), now)
        gate.command(command(1000 + 200 * k), now)
