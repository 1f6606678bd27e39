"""How good trajectories are: of any system, on recordings with ground truth or without."""
