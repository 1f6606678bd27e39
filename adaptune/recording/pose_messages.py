"""Poses in ROS messages."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptune import geometry
from adaptune.errors import nearest
from adaptune.recording.scan import SequenceError
from adaptune.trajectory import Trajectory

Pose = tuple[int, str, Any, Any]
"""Stamp, frame, translation, quaternion."""


def message_stamp(message: Any) -> int:
    """Nanoseconds of a message's header."""
    return int(message.header.stamp.sec) * 10**9 + int(message.header.stamp.nanosec)


def _header_pose(message: Any, pose: Any) -> list[Pose]:
    return [(message_stamp(message), message.header.frame_id, pose.position, pose.orientation)]


def _transforms(transforms: Iterable[Any]) -> list[Pose]:
    return [
        (message_stamp(t), t.child_frame_id, t.transform.translation, t.transform.rotation)
        for t in transforms
    ]


POSES: dict[str, Callable[[Any], list[Pose]]] = {
    "geometry_msgs/msg/PoseStamped": lambda m: _header_pose(m, m.pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": lambda m: _header_pose(m, m.pose.pose),
    "nav_msgs/msg/Odometry": lambda m: _header_pose(m, m.pose.pose),
    "nav_msgs/msg/Path": lambda m: [pose for p in m.poses for pose in _header_pose(p, p.pose)],
    "geometry_msgs/msg/TransformStamped": lambda m: _transforms([m]),
    "tf2_msgs/msg/TFMessage": lambda m: _transforms(m.transforms),
    "tf/msg/tfMessage": lambda m: _transforms(m.transforms),
}
"""Poses in a message, by its type."""
# Each message of this type repeats all poses of the one before.
PATH = "nav_msgs/msg/Path"
STATIC = "/tf_static"
_BEGIN, _END, _FOREVER = 0, 4 * 10**18, 5e9  # nanoseconds of fixed transforms, and seconds
TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def of_frame(topic: str, poses: Sequence[Pose], frame: str | None) -> list[Pose]:
    """Poses of one child frame; of the only one if `frame` is None, else a SequenceError."""
    frames = sorted({name for _, name, *_ in poses})
    if frame is None and len(frames) > 1:
        help_ = f"name one of them as `child_frame`, or a chain: {', '.join(frames)}"
        raise SequenceError(f"{topic} has the transforms of several frames, {help_}")
    if frame is not None and frame not in frames:
        raise SequenceError(f"{topic}: no frame {frame}; {nearest(frame, frames)}")
    return [pose for pose in poses if frame in (None, pose[1])]


def usable(poses: Sequence[Pose]) -> tuple[Trajectory | None, list[str]]:
    """Trajectory of the usable poses, each stamp once, or None, and what is left out.

    Poses are usable if they are finite and have a rotation, and are of the frame that most are of:
    two nodes may publish on a topic.
    """
    (frame, n), *others = Counter(name for _, name, *_ in poses).most_common()
    left_out = [
        f"{m} of {n + m} poses are of the frame {name!r}, not {frame!r}" for name, m in others
    ]
    poses = [pose for pose in poses if pose[1] == frame]
    stamps = np.array([stamp for stamp, *_ in poses], np.int64)
    values: NDArray[np.float64] = np.array(
        [(p.x, p.y, p.z, q.x, q.y, q.z, q.w) for _, _, p, q in poses]
    )
    with np.errstate(invalid="ignore", over="ignore"):
        norms = np.linalg.norm(values[:, 3:], axis=1)
    good = np.isfinite(values).all(axis=1) & np.isfinite(norms) & (norms > 0.1)
    if unusable := int(np.count_nonzero(~good)):
        left_out += [f"{unusable} of {len(poses)} poses are not finite or have no rotation"]
    if not good.any():
        return None, left_out
    unique, index = np.unique(stamps[good], return_index=True)
    values = values[good][index]
    T = geometry.from_quaternions(values[:, :3], values[:, 3:])
    return Trajectory(unique, T), left_out


def untimed(poses: Sequence[Pose]) -> str:
    """What is wrong with poses whose stamps were never set; empty for others."""
    first, same = poses[0][0], len({stamp for stamp, *_ in poses}) == 1 < len(poses)
    return f"all its {len(poses)} poses have the stamp {first * 1e-9:.10g} s" if same else ""


def chained(moving: Sequence[Any], fixed: Sequence[Any], parent: str, child: str) -> Trajectory:
    """Poses of a frame in another one, at the stamps of the link that moves most often.

    `moving` and `fixed` are transforms. A ValueError says why there is no chain.
    """
    links: dict[str, dict[str, list[Pose]]] = defaultdict(lambda: defaultdict(list))
    for t in moving:
        links[t.child_frame_id.lstrip("/")][t.header.frame_id.lstrip("/")] += _transforms([t])
    for t in fixed:
        always = [(stamp, *_transforms([t])[0][1:]) for stamp in (_BEGIN, _END)]
        links[t.child_frame_id.lstrip("/")][t.header.frame_id.lstrip("/")] = always
    way, frame = list[Trajectory](), child.lstrip("/")
    while frame != parent.lstrip("/") or not way:
        if frame not in links or len(way) > len(links):
            known = ", ".join(sorted({*links, *(above for of in links.values() for above in of)}))
            raise ValueError(f"no chain leads from {parent} to {child}; there is {known}")
        if len(links[frame]) > 1:
            both = " and ".join(links[frame])
            raise ValueError(f"{frame} has two parents, {both}: two nodes publish it; record one")
        ((frame, poses),) = links[frame].items()
        if (link := usable(poses)[0]) is None:
            raise ValueError(f"{poses[0][1]} has no pose that is finite")
        way.append(link)
    stamps = max((link.stamps for link in way), key=len)
    T = np.eye(4)
    for link in reversed(way):
        T = T @ link.at(stamps, _FOREVER)
    known_poses = np.isfinite(T[:, 0, 0])
    return Trajectory(stamps[known_poses], T[known_poses])
