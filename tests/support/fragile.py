"""An odometry that fails with some of its parameter sets."""

import zlib
from typing import Literal

import drives
from fake_odometry import Fake

from adaptune.odometry.keyframe import KeyframeSettings

NAME = "fragile:Fragile"
MOST = 2.0
"""Sets with a larger `keyframe_interval` fail."""
TWO = {zlib.crc32(points[:64].tobytes()) for _, points, _ in drives.scans(1, 40)}


class Settings(KeyframeSettings):
    fails: Literal["always", "every fifth", "in two", "but the baseline"] = "always"


class Fragile(Fake):
    """The fake odometry; a set that fails raises at once, and so takes no time."""

    settings_type = Settings

    def register(self, prepared):
        if self.fails(zlib.crc32(prepared.points[:64].tobytes())):
            raise RuntimeError("too coarse")
        return super().register(prepared)

    def fails(self, scan):
        interval, fails = self.parameters["keyframe_interval"], self.settings.fails
        if fails == "but the baseline":
            return interval != 1.0
        now = {"always": True, "every fifth": scan % 5 == 0, "in two": scan in TWO}
        return interval > MOST and now[fails]
