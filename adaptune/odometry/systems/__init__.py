"""Odometries that are whole programs: in Docker images, ROS workspaces, or started by a command."""
