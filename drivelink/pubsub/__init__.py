"""The zenoh side: bytes, keys, sessions, the publisher and the clients; ROS 2 by way of the same session."""
