"""The table of topics and queryables, from which recorder, health, docs and tests derive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from common.messages import definitions as m
from common.messages import requests as r

ROOT = "presage"
# Roles, as they stand in certificates; what each is for: common/bus/security.py. Services have the role of their name.
CONTROL_ROLES = ("operator", "viewer-control")  # may move the robot, delete, or change what runs
SERVICE_ROLES = ("simulator", "bridge_ros2", "estimator", "controller", "recorder", "viewer", "viewer-control")
ROBOT_ROLES = ("simulator", "bridge_ros2")  # speaks for the robot
GOAL_ROLES = (*CONTROL_ROLES, "bridge_ros2")  # whoever sits at rviz
COMPUTE_ROLES = (*SERVICE_ROLES, "operator")  # may ask for work that costs time
ALL_ROLES = (*SERVICE_ROLES, "operator", "observer", "replay", "remote")
MAX_BYTES = 1 << 20  # a larger payload is not even queued


@dataclass(frozen=True)
class Topic:
    """One row: what is sent, by whom, how often, and what a full queue does."""

    name: str
    message: type[m.Stamped]
    publisher: str  # the service(s) that publish it
    rate: float  # Hz nominal; 0: when something happens
    queue: Literal["newest", "all"]  # what a receiver keeps that falls behind; the recorder keeps all of everything
    recorded: bool = True
    per_service: bool = False  # one key a service, beneath the topic's own
    multiple_publishers: bool = False  # several may publish it at once; else the first counts until it is silent
    latched: bool = False  # whoever hears it tells the last one to services that come later
    publisher_roles: tuple[str, ...] = ()  # roles; none: the publisher's, and of a per-service topic each service its own
    about: str = ""

    def key(self, robot: str, service: str = "*") -> str:
        """The key expression; for a per-service topic ``service`` is the last chunk."""
        return f"{ROOT}/{robot}/{self.name}" + (f"/{service}" if self.per_service else "")


@dataclass(frozen=True)
class Query:
    """One queryable: request in, reply out."""

    name: str
    request: type[r.Request]
    reply: type[r.Reply]
    server: str
    per_service: bool = False
    requester_roles: tuple[str, ...] = CONTROL_ROLES  # roles
    about: str = ""

    def key(self, robot: str, service: str = "*") -> str:
        """The key expression."""
        return f"{ROOT}/{robot}/{self.name}" + (f"/{service}" if self.per_service else "")


SCAN = Topic("scan", m.Scan, "simulator", 15, "newest", publisher_roles=ROBOT_ROLES, about="what the laser sees")
ODOM = Topic("odom", m.Odom, "simulator", 15, "newest", publisher_roles=ROBOT_ROLES, about="dead reckoning, drifts")
TRUTH = Topic("truth", m.Truth, "simulator", 15, "newest", about="where the robot really is")
BELIEF = Topic("belief", m.Belief, "estimator", 15, "newest", about="where the estimator believes it is, and F")
PREDICTION = Topic("prediction", m.Prediction, "estimator", 15, "newest", about="the scan expected at the belief")
CMD_VEL = Topic("cmd_vel", m.CmdVel, "controller", 15, "newest", about="velocity command")
GOAL = Topic(
    "goal", m.Goal, "presage goal, viewer", 0, "newest", multiple_publishers=True, latched=True, publisher_roles=GOAL_ROLES, about="where to go"
)
DRIVE = Topic(
    "drive", m.Drive, "viewer", 0, "newest", multiple_publishers=True, publisher_roles=CONTROL_ROLES, about="velocity by hand, before any goal"
)
STATUS = Topic("status", m.Status, "controller", 15, "newest", latched=True, about="what the controller does, and why")
PLAN = Topic("plan", m.Plan, "controller", 0, "newest", about="the way ahead, and what the map does not know")
PREFERENCE = Topic(
    "preference",
    m.Preference,
    "controller",
    0,
    "newest",
    about="the goal prior, on change and every 5 s",
)
HEALTH = Topic(
    "health", m.Health, "every service", 1, "all", per_service=True, multiple_publishers=True, about="counters of a service"
)

TOPICS: tuple[Topic, ...] = (
    SCAN,
    ODOM,
    TRUTH,
    BELIEF,
    PREDICTION,
    GOAL,
    DRIVE,
    CMD_VEL,
    STATUS,
    PLAN,
    PREFERENCE,
    HEALTH,
)

TELEPORT = Query("teleport", r.PoseRequest, r.Reply, "simulator", about="carry the robot to a pose")
RESET = Query("reset", r.ResetRequest, r.Reply, "simulator", about="begin anew, with a seed")
PAUSE = Query("pause", r.Request, r.Reply, "simulator", about="stop the simulation's clock")
RESUME = Query("resume", r.Request, r.Reply, "simulator", about="let it run on")
STEP = Query("step", r.Request, r.Reply, "simulator", about="while paused, one scan further")
SPEED = Query("speed", r.SpeedRequest, r.Reply, "simulator", about="how fast the simulation's clock runs")
OBSTACLE = Query("obstacle", r.ObstacleRequest, r.Reply, "simulator", about="add, move or remove furniture")
SAMPLE = Query(
    "sample",
    r.SampleRequest,
    r.SampleReply,
    "simulator",
    requester_roles=COMPUTE_ROLES,
    about="the scans seen from a batch of poses",
)
WORLD = Query("world", r.Request, r.WorldReply, "simulator", requester_roles=ALL_ROLES, about="world, scanner and robot as data")
LOCALISE = Query("localise", r.LocaliseRequest, r.Reply, "estimator", requester_roles=GOAL_ROLES, about="begin localisation anew")
PLAYER = Query("player", r.PlayerRequest, r.PlayerReply, "replay", about="pause, step, seek a replay")
RECORDING = Query("recording", r.RecordRequest, r.RecordReply, "recorder", about="begin or end a recording")
MODEL = Query(
    "model", r.ModelRequest, r.ModelReply, "estimator", requester_roles=ALL_ROLES, about="the model in use: card, map, weights"
)
PREDICT = Query(
    "predict",
    r.PredictRequest,
    r.PredictReply,
    "estimator",
    requester_roles=COMPUTE_ROLES,
    about="the scans expected from poses",
)
CONFIG = Query(
    "config",
    r.Request,
    r.ConfigReply,
    "every service",
    per_service=True,
    requester_roles=ALL_ROLES,
    about="effective configuration",
)

QUERIES: tuple[Query, ...] = (
    TELEPORT, RESET, PAUSE, RESUME, STEP, SPEED, OBSTACLE, SAMPLE, WORLD, LOCALISE, PLAYER, RECORDING, MODEL, PREDICT,
    CONFIG,
)  # fmt: skip


def alive_key(robot: str, service: str = "*", instance: str = "*") -> str:
    """Liveliness token of a service's instance that leads."""
    return f"{ROOT}/{robot}/alive/{service}/{instance}"


def standby_key(robot: str, service: str = "*", instance: str = "*") -> str:
    """Liveliness token of one that waits until no other leads."""
    return f"{ROOT}/{robot}/standby/{service}/{instance}"


def topic_of(key: str) -> Topic | None:
    """The row a concrete key belongs to, or None."""
    parts = key.split("/")
    for topic in TOPICS:
        depth = 4 if topic.per_service else 3
        if len(parts) == depth and parts[0] == ROOT and parts[2] == topic.name:
            return topic
    return None


def expected_rate(topic: Topic, scan_time: float) -> float:
    """Hz of a topic where a scan comes each ``scan_time`` s (0: not said): the table has those of a 15 Hz scanner."""
    return 1 / scan_time if scan_time > 0 and topic.rate == SCAN.rate else topic.rate
