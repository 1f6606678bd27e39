"""The odometries that evalio carries, compiled."""
