"""The odometries by name, imported when they are asked for."""

from contextlib import suppress
from importlib import metadata
from typing import TYPE_CHECKING

from adaptune import plugins
from adaptune.odometry.base import Odometry, OdometryError

if TYPE_CHECKING:
    from adaptune.odometry.docker.rustle import Rustle
    from adaptune.odometry.isolation import Isolated
    from adaptune.odometry.whole_run import WholeRun

ENTRY_POINTS = "adaptune.odometries"
"""Group in which other packages announce their odometries, each by its name."""

ODOMETRIES = {
    "ct_icp": "adaptune.odometry.evalio.lidar:CtIcp",
    "dlio": "adaptune.odometry.evalio.lidar_inertial:Dlio",
    "evalio_kiss_icp": "adaptune.odometry.evalio.lidar:KissIcp",
    "form": "adaptune.odometry.evalio.lidar:Form",
    "genz_icp": "adaptune.odometry.evalio.lidar:GenzIcp",
    "gicp": "adaptune.odometry.gicp:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "lio_sam": "adaptune.odometry.evalio.lidar_inertial:LioSam",
    "loam": "adaptune.odometry.evalio.lidar:Loam",
    "mad_icp": "adaptune.odometry.evalio.lidar:MadIcp",
    "ndt": "adaptune.odometry.ndt:KeyframeNdt",
    "rko_lio": "adaptune.odometry.rko_lio:RkoLio",
    "vgicp": "adaptune.odometry.gicp:KeyframeVgicp",
}

PROGRAMS = {
    "command": "adaptune.odometry.command:Command",
    "docker_command": "adaptune.odometry.docker.docker_command:DockerCommand",
    "docker_process": "adaptune.odometry.docker.docker_process:DockerProcess",
    "process": "adaptune.odometry.process:Process",
    "rustle": "adaptune.odometry.docker.rustle:Rustle",
}
"""Programs of the user."""

CONTAINERS = ("docker_command", "docker_process", "rustle")
"""Those of them that run in containers."""

PACKAGES = {"gicp": "small_gicp", "kiss_icp": "kiss-icp", "ndt": "open3d"}
"""Packages that our adapters run on, if the adapter's module has another name."""

AnyOdometry = type[Odometry] | type["Isolated"] | type["WholeRun"] | type["Rustle"]


def is_user_class(name: str) -> bool:
    """Whether an odometry is a class that is not adaptune's: another package's, or the user's."""
    return name not in ODOMETRIES and name not in PROGRAMS


def where(name: str) -> str:
    """Where the class of an odometry is, as ``module:Class``, without importing it.

    Raises
    ------
    OdometryError
        If there is no such odometry, with the nearest name.
    """
    try:
        return plugins.path_of(name, "odometry", ODOMETRIES | PROGRAMS, ENTRY_POINTS, "Class")
    except plugins.PluginError as error:
        raise OdometryError(str(error)) from error


def odometry_class(name: str) -> "AnyOdometry":
    """Class of an odometry; see `adaptune.odometry.declaration` for a user's.

    Parameters
    ----------
    name
        One of `ODOMETRIES` or `PROGRAMS`, one that an installed package announces in the
        entry-point group ``adaptune.odometries``, or ``module:Class``.

    Raises
    ------
    OdometryError
        If there is no such odometry, with the nearest name, or if the class cannot be used.
    """
    try:
        found = plugins.load(name, where(name), "class")
    except plugins.PluginError as error:
        raise OdometryError(str(error)) from error
    if name in PROGRAMS:
        return found  # type: ignore[no-any-return]
    if not (isinstance(found, type) and issubclass(found, Odometry)):
        raise OdometryError(f"{name}: is not a class derived from adaptune.odometry.Odometry")
    if lacking := [key for key in ("space", "live") if not hasattr(found, key)]:
        raise OdometryError(f"{name}: the class has no attribute {' and no '.join(lacking)}")
    return found


def versions(name: str) -> dict[str, str]:
    """Versions of what a trial's outcome may depend on: adaptune, numpy, the odometry's package."""
    names = {"adaptune", "numpy"}
    module = where(name).partition(":")[0]
    top = module.removeprefix(f"{__package__}.").partition(".")[0]
    if module.startswith(f"{__package__}."):
        names.add(PACKAGES.get(top, top))
    else:
        names |= set(metadata.packages_distributions().get(top, ()))
    found = {}
    for package in sorted(names):
        with suppress(metadata.PackageNotFoundError):  # written by the user, or built in
            found[package] = metadata.version(package)
    return found
