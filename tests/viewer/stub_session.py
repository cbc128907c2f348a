"""A standing robot for the stub server, with the messages of its scanner, estimator and controller."""

from __future__ import annotations

from collections import deque

import numpy as np

from common.geometry.world import Obstacle, World
from common.robot.scanner import SCANNERS
from services.viewer.state.frames import encode_frame
from tests.viewer import stub_plan

SCENES = (
    "tracking",
    "planning",
    "blocked",
    "exploring",
    "ambiguous",
    "lost",
    "no-estimator",
    "empty",
    "watch-only",
    "mapped",
    "floors",
)
WORLDS = {"planning": "office", "blocked": "office", "exploring": "maze"}  # other scenes: corridor
PLANNED = tuple(WORLDS)
REASONS = {
    "blocked": "no way around something that is not in the map at (12.3, 1.4): waiting until it clears",
    "exploring": "2 places are possible: going to (6.3, 4.1) to tell them apart",
}
PAST = (("idle", ""), ("navigating", ""), ("blocked", "an obstacle in the scan is in the way"), ("navigating", ""))
SCANNER = SCANNERS["tim571"]
DT = 1 / SCANNER.rate
COVARIANCE = (4e-6, 1e-6, 0, 1e-6, 2.5e-6, 0, 0, 0, 3e-6)
WIDE_COVARIANCE = (0.09, 0.02, 0, 0.02, 0.04, 0, 0, 0, 0.02)


class Session:
    """A robot at the world's start with a goal across the room."""

    def __init__(self, world: World, scene: str) -> None:
        self.map, self.scene = world, scene
        self.world = world  # with the obstacles that visitors added
        self.rng = np.random.default_rng(1)
        self.pose = world.start_pose(0.3)
        self.time = 0.0  # s, of the last frame
        self.planner = stub_plan.Planner(world) if scene in PLANNED else None
        places = world.sample_free(60, self.rng, 0.5)
        self.goal = np.asarray(places[np.argmax(np.hypot(*(places - self.pose[:2]).T))])  # x, y and perhaps yaw
        self.history: deque[list[float]] = deque(maxlen=900)
        self.paused = False

    def step(self) -> bytes:
        """Advances by one scan and returns the frame."""
        self.time += DT
        return self.frame()

    def belief(self) -> tuple[str, np.ndarray, list[dict]]:
        """The belief: state, pose, hypotheses."""
        x0, y0, x1, y1 = self.map.bounds
        if self.scene == "lost":
            return "lost", self.pose + np.array([2.6, -0.4, 0.5]), []
        if self.scene in {"ambiguous", "exploring"}:
            mirror = np.array([x0 + x1 - self.pose[0], y0 + y1 - self.pose[1], self.pose[2] + np.pi])
            poses = [
                mirror,
                *(self.pose + np.array([[0.5, 0.1, 0.1], [-2.0, 0.3, 0.2]])),
                mirror + np.array([1.5, -0.2, 0.1]),
            ]
            weights = (0.46, 0.38, 0.11, 0.05)
            hypotheses = [hypothesis(p, w, WIDE_COVARIANCE) for p, w in zip(poses, weights, strict=True)]
            return "ambiguous", mirror, hypotheses
        pose = self.pose + self.rng.normal(0, [0.0015, 0.0012, 0.001])
        return "tracking", pose, [hypothesis(pose, 1.0, COVARIANCE)]

    def frame(self) -> bytes:
        """The frame of the current time."""
        angles = SCANNER.angles()
        measured = self.world.ray_distances([self.laser(self.pose)], angles)[0]
        measured = SCANNER.limit(measured + self.rng.normal(0, 0.012, len(measured)))
        state, pose, hypotheses = self.belief()
        expected = self.map.ray_distances([self.laser(pose)], angles)[0]
        sigma = np.clip(0.018 + 0.6 * np.abs(np.gradient(expected)), 0.018, 1.2)
        z = np.where(np.isfinite(measured), (measured - expected) / sigma, 0)
        accuracy = float(np.sum(np.minimum(0.5 * z**2, 12) + np.log(sigma * np.sqrt(2 * np.pi))))
        complexity = 7.5 + 1.2 * float(self.rng.normal()) + (30 if state != "tracking" else 0)
        error = float(np.hypot(*(pose - self.pose)[:2]))
        self.history.append([self.time, accuracy + complexity, accuracy, complexity, error, 0.0])
        silent = self.scene == "no-estimator"
        covariance = COVARIANCE if state == "tracking" else WIDE_COVARIANCE
        status = self.status(state)
        distance = float(np.hypot(*(self.goal[:2] - self.pose[:2])))
        reason = {"lost": f"standing until localised: the belief is {state}", **REASONS}.get(status, "")
        goal = self.goal
        if self.planner is not None:
            self.planner.aim(goal[:2], self.time)
        header = {
            "type": "frame", "t": self.time, "stamp_ns": int(self.time * 1e9), "robot": "robot",
            "truth": {**as_pose(self.pose), "contact": False, "stopped": False},
            "belief": None if silent else {
                "state": state, **as_pose(pose), "cov": list(covariance),
                "free_energy": accuracy + complexity, "accuracy": accuracy, "complexity": complexity,
                "hypotheses": hypotheses, "estimator": "stub",
                "probability": 0.9999 if state == "tracking" else 0.4, "protection": [0.03, 0.02, 0.005],
            },
            "odom": None, "cmd": None, "error": None if silent else error, "speed": 0.0,
            "status": {
                "state": status, "reason": reason, "distance": distance,
                "goal": {
                    "x": goal[0], "y": goal[1], "yaw": goal[2] if len(goal) > 2 else 0.0, "tolerance": 0.2,
                    "yaw_tolerance": 0.15 if len(goal) > 2 else None,
                },
                "energy": {
                    "risk": 0.12, "ambiguity": 0.002, "pose_information": 0.0001, "place_information": 0.0,
                    "probability": 0.4,
                },
            },
            "latency_ms": 6.4 + float(self.rng.normal()),
            "scan": {
                "angle_min": SCANNER.angle_min, "angle_increment": SCANNER.angle_increment,
                "range_max": SCANNER.range_max,
                "mount": as_pose(np.array(SCANNER.mount)),
            },
        }  # fmt: skip
        none = np.zeros(0, np.float32)
        return encode_frame(header, {
            "ranges": measured.astype(np.float32),
            "predicted": none if silent else expected.astype(np.float32),
            "sigma": none if silent else sigma.astype(np.float32),
            **{name: np.asarray(points, np.float32).ravel() for name, points in self.plan(pose).items()},
        })  # fmt: skip

    def status(self, state: str) -> str:
        """State of the controller for a belief's state."""
        if self.scene in REASONS:
            return self.scene
        return "lost" if state != "tracking" else "navigating"

    def plan(self, pose: np.ndarray) -> dict[str, np.ndarray]:
        """Points of the plan in the map, in m, by name."""
        if self.planner is None:
            return {}
        people = stub_plan.people(self.time, self.map)
        return {
            "path": self.planner.path(pose[:2]),
            "motion": stub_plan.motion(pose, np.array([0.5, 0.0, 0.2])),
            "people": people,
            "obstacles": stub_plan.seen_of(people, pose[:2]),
        }

    def journal(self) -> dict:
        """Earlier states of the controller."""
        past = [{"t": self.time - 9 + 2 * i, "state": s, "reason": r} for i, (s, r) in enumerate(PAST)]
        now = [{"t": self.time, "state": self.scene, "reason": REASONS[self.scene]}] if self.scene in REASONS else []
        return {"type": "journal", "rows": [*past, *now]}

    def laser(self, pose: np.ndarray) -> np.ndarray:
        """Pose of the scanner for a pose of the robot."""
        return pose + SCANNER.mount[0] * np.array([np.cos(pose[2]), np.sin(pose[2]), 0])

    def act(self, request: dict) -> dict:
        """Handles a visitor's request. Returns the fields of the answer."""
        if self.scene == "watch-only":
            return {"ok": False, "reason": "visitors only watch here"}
        handle = getattr(self, f"do_{request.get('do')}", None)
        reason = (handle and handle(request)) or ""
        return {"ok": not reason, "reason": reason}

    def do_goal(self, request: dict) -> str:
        if self.world.clearance([[request["x"], request["y"]]])[0] < 0.27:
            return "the robot does not fit there"
        self.goal = np.array([request["x"], request["y"], *([request["yaw"]] if "yaw" in request else [])])
        return ""

    def do_teleport(self, request: dict) -> None:
        self.pose = np.array([request["x"], request["y"], request["yaw"]])

    def do_obstacle(self, request: dict) -> None:
        others = [o for o in self.world.obstacles if o.name != request["name"]]
        new = [] if request["action"] == "remove" else [Obstacle.model_validate(request["obstacle"])]
        self.world = World.model_validate(self.world.model_copy(update={"obstacles": others + new}).model_dump())

    def do_pause(self, _: dict) -> None:
        self.paused = True

    def do_resume(self, _: dict) -> None:
        self.paused = False


def as_pose(pose: np.ndarray) -> dict:
    """Fields of a pose."""
    return {"x": float(pose[0]), "y": float(pose[1]), "yaw": float(pose[2])}


def hypothesis(pose: np.ndarray, weight: float, cov: tuple[float, ...]) -> dict:
    """One hypothesis."""
    return {**as_pose(pose), "weight": weight, "cov": list(cov)}


def services_message(scene: str) -> dict:
    """The message about services, in which those that the scene lacks are missing."""
    published = {
        "simulator": ("scan", "odom", "truth"),
        "estimator": ("belief", "prediction"),
        "controller": ("cmd_vel", "status"),
        "recorder": (),
    }
    received = {
        "simulator": ("cmd_vel",),
        "estimator": ("scan", "odom"),
        "controller": ("belief", "goal", "scan"),
        "recorder": ("scan", "odom", "truth", "belief", "prediction", "cmd_vel", "status"),
    }
    gone = {"no-estimator": {"estimator"}, "empty": set(published)}.get(scene, set())
    quiet = {"published_hz": 0, "received_hz": 0, "dropped": 0, "undecodable": 0}
    rows = [
        {
            "name": name, "state": "alive", "alive": True, "age_s": 0.4, "uptime_s": 754.0, "note": "",
            "idle": name == "recorder",
            "rates": [{**quiet, "topic": t, "published_hz": 15.0} for t in published[name]]
            + [{**quiet, "topic": t, "received_hz": 15.0, "dropped": 2 * (t == "scan")} for t in received[name]],
        }
        for name in published if name not in gone
    ]  # fmt: skip
    missing = [
        {"name": n, "start": f"python -m services.{n}"} for n in ("simulator", "estimator", "controller") if n in gone
    ]
    return {"type": "services", "services": rows, "missing": missing}
