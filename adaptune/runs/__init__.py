"""Runs of an odometry along a recording: how one is driven, what it did, and how it is kept."""
