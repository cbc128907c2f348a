"""The table of topics and queryables, from which recorder, health, docs and tests derive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from common.messages import definitions as m
from common.messages import requests as r

ROOT = "presage"
ROBOT_NAME_PATTERN = r"[A-Za-z0-9_.-]{1,64}"  # the second part of a key
SCAN_RATE_HZ = 15  # nominal rate of the topics that are published once for each scan
# Roles as named in certificates, described in common/bus/security.py. The role of a service has the service's name.
CONTROL_ROLES = ("operator", "viewer-control")  # may move the robot, delete data, or change what runs
SERVICE_ROLES = (
    "simulator", "bridge_ros2", "estimator", "mapper", "controller", "recorder", "viewer", "viewer-control",
)  # fmt: skip
ROBOT_ROLES = ("simulator", "bridge_ros2")  # publish what the robot measures
GOAL_ROLES = (*CONTROL_ROLES, "bridge_ros2")  # may set goals and poses; with the bridge, rviz may
COMPUTE_ROLES = (*SERVICE_ROLES, "operator")  # may send requests that need much computing time
ALL_ROLES = (*SERVICE_ROLES, "operator", "observer", "replay", "remote")
MAX_BYTES = 1 << 20  # larger payloads are dropped before they are queued
MAX_REQUEST_BYTES = 64 * MAX_BYTES  # the same for requests and replies


@dataclass(frozen=True)
class Topic:
    """One row of the table: what is published, by which service, how often, and how receivers queue it."""

    name: str
    message: type[m.Stamped]
    publisher: str  # the service that publishes it; if there are several, only a text for tables and messages
    rate: float  # nominal, Hz; 0 if it is published on events
    queue: Literal["newest", "all"]  # which messages a slow receiver keeps; the recorder always keeps all
    recorded: bool = True
    per_service: bool = False  # each service has its own key below that of the topic
    multiple_publishers: bool = False  # several sessions may publish at once; else the first, until it is silent
    latched: bool = False  # subscribers store the last message for services that start later
    publisher_roles: tuple[str, ...] = ()  # defaults to the publisher; of a per-service topic, to the service itself
    about: str = ""

    def key(self, robot: str, service: str = "*") -> str:
        """The key expression; for a per-service topic, ``service`` is the last chunk."""
        return f"{ROOT}/{robot}/{self.name}" + (f"/{service}" if self.per_service else "")


@dataclass(frozen=True)
class Query:
    """One row of the table of requests: its messages, the service that replies, and the roles that may send it."""

    name: str
    request: type[r.Request]
    reply: type[r.Reply]
    server: str  # the service that replies
    per_service: bool = False  # each service has its own key below that of the query
    requester_roles: tuple[str, ...] = CONTROL_ROLES
    about: str = ""

    def key(self, robot: str, service: str = "*") -> str:
        """The key expression; for a per-service query, ``service`` is the last chunk."""
        return f"{ROOT}/{robot}/{self.name}" + (f"/{service}" if self.per_service else "")


SCAN = Topic(
    "scan",
    m.Scan,
    "simulator",
    SCAN_RATE_HZ,
    "newest",
    publisher_roles=ROBOT_ROLES,
    about="the laser scan, stamped with the time of the beam that was measured first",
)
ODOM = Topic(
    "odom",
    m.Odom,
    "simulator",
    SCAN_RATE_HZ,
    "newest",
    publisher_roles=ROBOT_ROLES,
    about="dead reckoning, which drifts",
)
TRUTH = Topic("truth", m.Truth, "simulator", SCAN_RATE_HZ, "newest", about="true state, from a simulator only")
BELIEF = Topic(
    "belief",
    m.Belief,
    "estimator",
    SCAN_RATE_HZ,
    "newest",
    publisher_roles=("estimator", "mapper"),
    about="posterior of the pose, with the stamp of the scan; while mapping, from the mapper",
)
PREDICTION = Topic(
    "prediction",
    m.Prediction,
    "estimator",
    SCAN_RATE_HZ,
    "newest",
    about="the scan predicted for the belief, with its stamp",
)
MAP = Topic(
    "map",
    m.Map,
    "mapper",
    0,
    "newest",
    about="the map so far, whose origin is where mapping began; on change and every 5 s",
)
FIELD = Topic(
    "field",
    m.LearnedField,
    "estimator",
    0,
    "all",
    about="distance field learned while driving, used for scans after the stamp; on change and every 30 s",
)
CMD_VEL = Topic(
    "cmd_vel",
    m.CmdVel,
    "controller",
    SCAN_RATE_HZ,
    "newest",
    about="velocity command, with the stamp of the scan that it responds to",
)
GOAL = Topic(
    "goal",
    m.Goal,
    "presage goal, viewer",
    0,
    "newest",
    multiple_publishers=True,
    latched=True,
    publisher_roles=GOAL_ROLES,
    about="pose to drive to",
)
DRIVE = Topic(
    "drive",
    m.Drive,
    "viewer",
    0,
    "newest",
    multiple_publishers=True,
    publisher_roles=CONTROL_ROLES,
    about="velocity steered by hand, which overrides the goal",
)
STATUS = Topic(
    "status", m.Status, "controller", SCAN_RATE_HZ, "newest", latched=True, about="what the controller does, and why"
)
PLAN = Topic("plan", m.Plan, "controller", 0, "newest", about="planned path, and obstacles outside the map")
PREFERENCE = Topic(
    "preference",
    m.Preference,
    "controller",
    0,
    "newest",
    about="goal prior over known free space, on change and every 5 s",
)
HEALTH = Topic(
    "health",
    m.Health,
    "every service",
    1,
    "all",
    per_service=True,
    multiple_publishers=True,
    about="state and counters of a service",
)

TOPICS: tuple[Topic, ...] = (
    SCAN,
    ODOM,
    TRUTH,
    BELIEF,
    PREDICTION,
    MAP,
    FIELD,
    GOAL,
    DRIVE,
    CMD_VEL,
    STATUS,
    PLAN,
    PREFERENCE,
    HEALTH,
)

TELEPORT = Query("teleport", r.PoseRequest, r.Reply, "simulator", about="move the robot to a pose")
RESET = Query("reset", r.ResetRequest, r.Reply, "simulator", about="restart, optionally with a new seed")
PAUSE = Query("pause", r.Request, r.Reply, "simulator", about="stop the simulation's clock")
RESUME = Query("resume", r.Request, r.Reply, "simulator", about="resume the simulation's clock")
STEP = Query("step", r.Request, r.Reply, "simulator", about="advance a paused simulation by one scan")
SPEED = Query("speed", r.SpeedRequest, r.Reply, "simulator", about="set the speed of the simulation's clock")
OBSTACLE = Query("obstacle", r.ObstacleRequest, r.Reply, "simulator", about="add, move or remove furniture")
SAMPLE = Query(
    "sample",
    r.SampleRequest,
    r.SampleReply,
    "simulator",
    requester_roles=COMPUTE_ROLES,
    about="simulate scans from given poses",
)
WORLD = Query(
    "world", r.Request, r.WorldReply, "simulator", requester_roles=ALL_ROLES, about="world, scanner and robot"
)
LOCALISE = Query(
    "localise",
    r.LocaliseRequest,
    r.Reply,
    "estimator",
    requester_roles=GOAL_ROLES,
    about="restart localisation, from a pose or globally",
)
PLAYER = Query("player", r.PlayerRequest, r.PlayerReply, "replay", about="control a replay")
RECORDING = Query("recording", r.RecordRequest, r.RecordReply, "recorder", about="start, stop or query a recording")
MODEL = Query(
    "model",
    r.ModelRequest,
    r.ModelReply,
    "estimator",
    requester_roles=ALL_ROLES,
    about="all that is needed to rebuild the estimator",
)
PREDICT = Query(
    "predict",
    r.PredictRequest,
    r.PredictReply,
    "estimator",
    requester_roles=COMPUTE_ROLES,
    about="predict scans from given poses",
)
SAVE_MAP = Query(
    "save_map",
    r.SaveMapRequest,
    r.SaveMapReply,
    "mapper",
    about="write the map as NAME.yaml, NAME.pgm and NAME.tum (the path)",
)
SAVE_MODEL = Query(
    "save_model",
    r.SaveModelRequest,
    r.SaveModelReply,
    "estimator",
    about="write the field learned while driving, as NAME-precise.safetensors and NAME-precise.json (card)",
)
CONFIG = Query(
    "config",
    r.Request,
    r.ConfigReply,
    "every service",
    per_service=True,
    requester_roles=ALL_ROLES,
    about="effective settings and versions",
)

QUERIES: tuple[Query, ...] = (
    TELEPORT,
    RESET,
    PAUSE,
    RESUME,
    STEP,
    SPEED,
    OBSTACLE,
    SAMPLE,
    WORLD,
    LOCALISE,
    PLAYER,
    RECORDING,
    MODEL,
    PREDICT,
    SAVE_MAP,
    SAVE_MODEL,
    CONFIG,
)


def alive_key(robot: str, service: str = "*", instance: str = "*") -> str:
    """Key of the liveliness token of an active instance of a service."""
    return f"{ROOT}/{robot}/alive/{service}/{instance}"


def standby_key(robot: str, service: str = "*", instance: str = "*") -> str:
    """Key of the liveliness token of an instance that waits until no other is active."""
    return f"{ROOT}/{robot}/standby/{service}/{instance}"


def topic_of(key: str) -> Topic | None:
    """The topic that a key belongs to, or None if there is none."""
    parts = key.split("/")
    for topic in TOPICS:
        depth = 4 if topic.per_service else 3
        if len(parts) == depth and parts[0] == ROOT and parts[2] == topic.name:
            return topic
    return None


def expected_rate(topic: Topic, scan_time: float) -> float:
    """Expected rate of a topic in Hz.

    Topics published once for each scan follow the scanner's period ``scan_time`` (s); if that is 0, it is unknown, and
    the nominal rate is returned.
    """
    return 1 / scan_time if scan_time > 0 and topic.rate == SCAN_RATE_HZ else topic.rate
