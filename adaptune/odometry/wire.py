"""Messages between a program and an odometry in another process, version 2.

Each is a JSON header and the raw bytes of arrays, see ``docs/programs.md``. The odometry
answers each with one of its own, with ``refused`` and a ``message`` if it cannot do what is asked,
or with ``fault`` and a ``message`` if it has ended. The other side ends by closing the stream.
"""

import resource
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from adaptune._system.processes import Answer, HostError, Message
from adaptune._system.strict import in_one_line
from adaptune.errors import OdometryError
from adaptune.odometry.base import Description, Registration
from adaptune.recording.scan import Imu, ImuNoise, Scan
from adaptune.space import ParameterSet, ParameterSpace

VERSION = 2
_SCAN_ARRAYS = ("points", "times", "rings", "intensities")
_IMU_ARRAYS = ("imu", "imu_stamps", "imu_pose", "imu_noise")


def scan_arrays(scan: Scan) -> dict[str, NDArray[Any] | None]:
    """A scan as the arrays of a message."""
    arrays: dict[str, NDArray[Any] | None] = {name: getattr(scan, name) for name in _SCAN_ARRAYS}
    if (imu := scan.imu) is not None:
        measured = np.hstack([imu.angular_velocity, imu.acceleration])
        noise = np.array(imu.noise)
        arrays |= zip(_IMU_ARRAYS, (measured, imu.stamps, imu.T_sensor_imu, noise), strict=True)
    return arrays


def to_scan(message: Message) -> Scan:
    """The scan that a message holds."""
    arrays, imu = message.arrays, None
    if "imu" in arrays:
        measured, stamps, T_sensor_imu, noise = (arrays[name] for name in _IMU_ARRAYS)
        gyro, acceleration = np.hsplit(measured, 2)
        imu = Imu(stamps, gyro, acceleration, T_sensor_imu, ImuNoise(*noise.tolist()))
    columns: Any = {name: arrays.get(name) for name in _SCAN_ARRAYS}
    return Scan(message.header["stamp"], imu=imu, **columns)


def hello(odometry: str | None, parameters: ParameterSet, settings: Any) -> dict[str, Any]:
    """First message of a conversation; no name where the other side is one odometry."""
    name: dict[str, Any] = {"type": "hello", "version": VERSION, "odometry": odometry}
    return name | {"parameters": parameters, "settings": settings}


def announced(answer: Message) -> Description:
    """Description of an odometry in its answer to a hello; an error if of another version."""
    header = answer.header
    if (version := header.get("version")) != VERSION:
        raise OdometryError(f"it speaks version {version} of the protocol, this adaptune {VERSION}")
    try:
        space = ParameterSpace.load(header["space"])
        return Description(space, bool(header["live"]), bool(header.get("needs_imu")))
    except (KeyError, TypeError, AttributeError, ValidationError) as error:
        what = in_one_line(error, header.get("space"))
        raise OdometryError(f"its answer to hello does not describe it: {what}") from error


def conversation(
    name: str, make: Callable[[str, ParameterSet, Any], tuple[Any, Description]]
) -> Answer:
    """Answer messages of adaptune with an odometry, which `make` makes and describes."""
    odometry: Any = None

    def answer(message: Message) -> dict[str, Any]:
        nonlocal odometry
        header = message.header
        if header["type"] != "hello":
            return answered(odometry, message)
        if (version := header["version"]) != VERSION:
            raise OdometryError(f"adaptune speaks version {VERSION} of the protocol, not {version}")
        odometry, described = make(name, header["parameters"], header["settings"])
        return {"version": VERSION, "odometry": name, **about(described)}

    return answer


def about(described: Description) -> dict[str, Any]:
    """A description as an answer holds it."""
    space = {} if described.space is None else described.space.definition()
    return {"live": described.live, "needs_imu": described.needs_imu, "space": space}


def unpacked(register: Any, returned: Any) -> Registration:
    """What an odometry's `register` returned; a HostError names it if that is no registration."""
    try:
        T_odom_sensor, registered = Registration(*returned)
        return Registration(np.array(T_odom_sensor, np.float64), bool(registered))
    except (TypeError, ValueError) as error:
        is_array = isinstance(returned, np.ndarray)
        what = f"an array of shape {returned.shape}" if is_array else f"{returned!r:.60}"
        code = getattr(register, "__code__", None)  # compiled methods have none
        where = f" ({code.co_filename}, line {code.co_firstlineno})" if code else ""
        name = getattr(register, "__qualname__", "register")
        raise HostError(
            f"{name}{where} returned {what}; let it return Registration(pose), "
            f"whose pose is an array of shape (4, 4)"
        ) from error


def answered(odometry: Any, message: Message, prepared: Any = None) -> dict[str, Any]:
    """Do what a message asks of an odometry, with its own scan if none is prepared; the answer."""
    header, arrays = message
    if header["type"] == "configure":
        odometry.configure(header["parameters"])
        return {}
    if prepared is None:
        prepared = odometry.prepare(to_scan(message))
    if header["type"] == "start":
        # Arrays from the stream are read-only; an odometry may change its poses.
        motion = arrays["motion"].copy() if "motion" in arrays else None
        odometry.start(prepared, arrays["pose"].copy(), motion)
        return {}
    try:
        pose, registered = unpacked(odometry.register, odometry.register(prepared))
    except HostError as error:
        return {"type": "fault", "message": str(error)}
    answer = {"type": "pose", "stamp": header["stamp"], "registered": registered}
    return answer | used() | {"pose": pose}


def used() -> dict[str, float]:
    """CPU seconds of this process, and its peak of memory in megabytes."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return {"cpu": usage.ru_utime + usage.ru_stime, "memory": usage.ru_maxrss * 1024e-6}
