"""Several odometries side by side, and the weighted mean of their motions."""
