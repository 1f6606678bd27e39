"""What carries messages between adaptune and a robot: ROS 1, or ROS 2."""

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from rosbags.typesys.store import Typestore

from adaptune.errors import AdaptuneError


class LinkError(AdaptuneError):
    """A robot that cannot be reached, or that refuses what is asked of it."""


class RosLink(Protocol):
    """A node of adaptune's in a robot's ROS.

    Messages are those of `store`, by names such as ``sensor_msgs/msg/PointCloud2`` in ROS 1, too.
    Every method may be called from any thread.

    Attributes
    ----------
    store : Typestore
        The types of all messages.
    """

    store: Typestore

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        """Have every message of a topic taken, one after the other, in a thread of its own."""

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:
        """Announce a topic; what is returned publishes a message on it."""

    def set_parameters(self, node: str, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Set parameters of another node; what it then holds, as far as it tells.

        Raises
        ------
        LinkError
            If the node is not there, does not answer, or refuses a value.
        """

    def topics(self) -> Mapping[str, str]:
        """The topics that somebody publishes now, and their types."""

    @property
    def alive(self) -> bool:
        """Whether messages still pass."""

    def close(self) -> None:
        """Leave."""
