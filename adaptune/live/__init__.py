"""Evidence from the drive itself: how wrong each odometry was over the last metres."""
