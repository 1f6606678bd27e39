"""What carries messages between adaptune and a robot: ROS 1, or ROS 2."""

import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

from adaptune.errors import AdaptuneError, in_a_line

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore


class LinkError(AdaptuneError):
    """A robot that cannot be reached, or that refuses what is asked of it."""


class BusyError(LinkError):
    """A node that is there has not answered yet; it may still take what it was sent."""


class RosLink(Protocol):
    """A node of adaptune's in a robot's ROS.

    Messages are those of `store`, by names such as ``sensor_msgs/msg/PointCloud2`` in ROS 1, too.
    Every method may be called from any thread.
    """

    store: "Typestore"  # the types of all messages
    is2: bool  # whether messages are serialised as in ROS 2

    def subscribe(
        self, topic: str, kind: str, take: Callable[[Any], None], raw: bool = False
    ) -> None:
        """Have messages, or their bytes if `raw`, taken one after the other, in a thread."""

    def advertise(self, topic: str, kind: str) -> Callable[[Any], None]:
        """Announce a topic; what is returned publishes a message on it."""

    def set_parameters(
        self, node: str, values: Mapping[str, Any], outdated: Callable[[], bool]
    ) -> Mapping[str, Any]:
        """Set parameters of another node; what it then holds, as far as it tells.

        There is a LinkError if the node is not there or refuses a value, and `BusyError` if it
        does not answer in time, or not before the values are `outdated`.
        """

    def topics(self) -> Mapping[str, str]:
        """The topics that somebody publishes now, and their types."""

    def why_unheard(self, topic: str) -> str:
        """Why others may get no messages of a topic, in words; empty where nothing is known."""

    @property
    def alive(self) -> bool:
        """Whether messages still pass."""

    def close(self) -> None:
        """Leave."""


_log = logging.getLogger(__name__)


def take_all(topic: str, messages: Iterable[Any], take: Callable[[Any], None]) -> threading.Thread:
    """Take message after message of a topic in a thread of its own, until they end."""

    def work() -> None:
        for message in messages:
            with telling(topic):
                take(message)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


@contextmanager
def telling(topic: str) -> Iterator[None]:
    """Log what goes wrong with a message."""
    try:
        yield
    except Exception as error:
        _log.warning("a message on %s is lost: %s", topic, in_a_line(error))
