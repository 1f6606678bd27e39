"""References that are computed from the recording itself, without ground truth."""
