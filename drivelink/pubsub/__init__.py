"""zenoh: bytes, keys, sessions, publisher, clients, ROS 2."""
