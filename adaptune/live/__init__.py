"""Live evidence: what a bank knows of its own errors while the robot drives."""
