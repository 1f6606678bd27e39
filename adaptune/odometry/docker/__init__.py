"""Odometries in Docker images."""
