"""An estimator of one's own: it follows the odometry from a known start, and answers every scan with a belief.

Run it beside the other services: presage up --no-estimator; python my_estimator.py --start 3,1.5,90
The base class connects, receives, sends health once a second, and ends at Ctrl-C.
"""

from typing import Any

from common.geometry import se2
from common.geometry.pose_text import parse_pose
from common.messages.definitions import Belief, Pose
from common.messages.topics import BELIEF, ODOM, SCAN, Topic
from common.runtime.config import ServiceSettings
from common.runtime.service import Service, main


class MySettings(ServiceSettings):
    """Settings; each is also an option of the command line and an environment variable."""

    service = "estimator"
    program = "python my_estimator.py"  # in --help
    start: str = "0,0,0"


class MyEstimator(Service):
    """Publishes a belief for each scan."""

    name = "estimator"
    inputs = (ODOM, SCAN)

    def open(self) -> None:
        """Reads the settings."""
        self.start, self.first, self.odom = parse_pose(self.settings.start, "--start"), None, None

    def on_message(self, topic: Topic, message: Any) -> None:
        """Stores odometry, and answers scans."""
        if topic is ODOM:
            self.odom = message.pose.array()
            self.first = self.odom if self.first is None else self.first
        elif self.odom is not None:
            pose = se2.compose(self.start, se2.between(self.first, self.odom))
            self.publish(BELIEF, Belief(stamp_ns=message.stamp_ns, state="tracking", pose=Pose.of(pose)))


if __name__ == "__main__":
    main(MySettings, MyEstimator)
