"""A policy of one's own: it drives a simulated robot in this process, and the free energy of each scan becomes CSV.

Run it: python own_policy.py run.csv
"""

import csv
import sys

import numpy as np

import presage
from common.geometry import se2
from common.messages.definitions import Belief, Goal, Pose, Status
from services.controller.navigator import Navigator
from services.controller.policies.decision import Decision, Policy
from services.simulator.simulation import Simulation, SimulationSetup

START, GOAL = (3.0, 1.5, 0.0), (6.0, 1.0)  # m, m, rad


class Proportional(Policy):
    """Drives straight at the goal. The navigator limits the velocity, and stops before obstacles and at the goal."""

    def set_goal(self, goal: np.ndarray | None) -> None:
        """Stores a goal (2,) m in map."""
        self.goal = goal

    def decide(self, belief: Belief, velocity: np.ndarray, motion_until_effect: np.ndarray) -> Decision:
        """Chooses a velocity in base_link when the pose is known."""
        pose = belief.pose.array()
        return Decision(np.array([*se2.rotate(-pose[2], self.goal - pose[:2]), 0.0]))

    def decide_unlocalised(self, belief: Belief, velocity: np.ndarray, motion_until_effect: np.ndarray) -> Decision:
        """Stands when the pose is not known."""
        return Decision(reason=f"the belief is {belief.state}", state="lost")


def drive(file: str, scans: int = 150) -> Status:
    """Drives to the goal, writes the file, and returns the last status."""
    world, scanner = presage.load_world("corridor"), presage.SCANNERS["tim571"].with_beams(200)
    estimator = presage.Estimator(world, scanner=scanner, initial_pose=START)
    simulation = Simulation(SimulationSetup(world, scanner, start=START, seed=1))
    navigator = Navigator(world=world, chosen_policy=Proportional())
    navigator.on_goal(Goal(stamp_ns=0, seq=1, pose=Pose(x=GOAL[0], y=GOAL[1])))
    with open(file, "w", newline="", encoding="utf-8") as stream:
        rows = csv.writer(stream)
        rows.writerow(["time_s", "free_energy_nats", "accuracy_nats", "complexity_nats", "error_m"])
        for _ in range(scans):
            _, truth, scan = simulation.observe()
            found = estimator.update(scan.ranges, stamp=scan.stamp_ns * 1e-9)
            belief = Belief(stamp_ns=scan.stamp_ns, state=found.state, pose=Pose.of(found.pose))
            navigator.on_scan(scan)
            command, status = navigator.step(belief)
            simulation.command(scan.stamp_ns, command.twist)
            simulation.advance()
            error = np.hypot(*(found.pose - truth.pose.array())[:2])
            rows.writerow([scan.stamp_ns * 1e-9, found.free_energy, found.accuracy, found.complexity, error])
            if status.state == "reached":
                break
    return status


if __name__ == "__main__":
    print(drive(sys.argv[1]).state)
