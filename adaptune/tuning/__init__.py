"""What the commands do, as functions: decide a study of recordings, tune, compare, and the page."""

TRIALS, EACH = 32, 16
"""Parameter sets to try, and at least for each of several odometries."""
