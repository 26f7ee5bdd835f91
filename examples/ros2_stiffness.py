"""A ROS 2 node that uses the stiffness of a joint only while it is valid and fresh.

RMW_IMPLEMENTATION=rmw_zenoh_cpp python examples/ros2_stiffness.py [JOINT [TOPIC]]

A daemon that is killed sends no last message, and ROS keeps the previous one: the reader must check the age.
"""

import math
import sys
import time
from typing import Any

STALE_S = 0.05  # 50 cycles at 1 kHz
FALLBACK_NM_RAD = 500.0  # what the controller assumes where it must not trust the estimate


class Stiffness:
    """The newest stiffness of one joint, from control_msgs/DynamicJointState."""

    def __init__(self, joint: str) -> None:
        self._joint = joint
        self._values: dict[str, float] = {}
        self._came_s = -math.inf

    def receive(self, message: Any, now_s: float) -> None:
        """Note a message that arrived now, by the local monotonic clock."""
        for name, one in zip(message.joint_names, message.interface_values, strict=True):
            if name == self._joint:
                self._values = dict(zip(one.interface_names, one.values, strict=True))
                self._came_s = now_s

    def state(self, now_s: float) -> str:
        """`live`, `invalid`, or `stale`: nothing came for `STALE_S`, so the daemon hangs or is gone."""
        if now_s - self._came_s > STALE_S:
            return "stale"
        trusted = self._values["valid"] and not self._values["model_alarm"]
        return "live" if trusted else "invalid"

    def value_nm_rad(self, now_s: float) -> float:
        """Stiffness to control with, N·m/rad."""
        return self._values["stiffness_nm_rad"] if self.state(now_s) == "live" else FALLBACK_NM_RAD


def main(joint: str = "elbow", topic: str = "/dynamic_joint_states") -> None:
    try:
        import rclpy
        from control_msgs.msg import DynamicJointState
    except ImportError as error:
        sys.exit(f"{error}: expected ROS 2, source /opt/ros/DISTRO/setup.sh, with control_msgs")

    rclpy.init()
    node = rclpy.create_node("stiffness_reader")
    stiffness = Stiffness(joint)

    def say() -> None:
        now_s = time.monotonic()
        node.get_logger().info(
            f"{joint}: {stiffness.state(now_s)}, {stiffness.value_nm_rad(now_s):.4g} N·m/rad"
        )

    node.create_subscription(DynamicJointState, topic, lambda m: stiffness.receive(m, time.monotonic()), 10)
    node.create_timer(0.5, say)
    rclpy.spin(node)


if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        sys.exit(print(__doc__))
    main(*sys.argv[1:])
