"""Connections to ROS 1 and ROS 2."""
