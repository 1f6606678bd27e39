"""The odometries by name, imported when they are asked for."""

from contextlib import suppress
from functools import cache
from importlib import metadata
from typing import Any

from pydantic import ValidationError

from adaptune import plugins
from adaptune.errors import OdometryError
from adaptune.odometry.base import Description, Odometry
from adaptune.odometry.wire import Served
from adaptune.space import ParameterSet
from adaptune.strict import in_one_line

ENTRY_POINTS = "adaptune.odometries"
"""Group in which other packages announce their odometries, each by its name."""

ODOMETRIES = {
    "ct_icp": "adaptune.odometry.evalio:CtIcp",
    "dlio": "adaptune.odometry.evalio:Dlio",
    "evalio_kiss_icp": "adaptune.odometry.evalio:KissIcp",
    "form": "adaptune.odometry.evalio:Form",
    "genz_icp": "adaptune.odometry.evalio:GenzIcp",
    "gicp": "adaptune.odometry.keyframe:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "lio_sam": "adaptune.odometry.evalio:LioSam",
    "loam": "adaptune.odometry.evalio:Loam",
    "mad_icp": "adaptune.odometry.evalio:MadIcp",
    "ndt": "adaptune.odometry.keyframe:KeyframeNdt",
    "rko_lio": "adaptune.odometry.rko_lio:RkoLio",
    "vgicp": "adaptune.odometry.keyframe:KeyframeVgicp",
}

PROGRAMS = {
    "command": "adaptune.odometry.program:Command",
    "docker_command": "adaptune.odometry.docker.programs:DockerCommand",
    "docker_process": "adaptune.odometry.docker.programs:DockerProcess",
    "process": "adaptune.odometry.remote:Process",
    "rustle": "adaptune.odometry.docker.rustle:Rustle",
}
"""Programs of the user."""

CONTAINERS = ("docker_command", "docker_process", "rustle")
"""Those of them that run in containers."""

PACKAGES = {"gicp": "small_gicp", "kiss_icp": "kiss-icp", "ndt": "open3d", "vgicp": "small_gicp"}
"""Packages that our odometries run on, where they are not named as the adapter's module is."""


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


def odometry_class(name: str) -> type[Any]:
    """Class of an odometry; see `adaptune.odometry.factory` for a user's.

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


def make_here(name: str, parameters: ParameterSet, settings: Any) -> tuple[Served, Description]:
    """Make an odometry in this process."""
    cls: Any = odometry_class(check_served(name))
    try:
        checked = cls.settings_type.model_validate(settings)
    except ValidationError as error:
        raise OdometryError(f"settings: {in_one_line(error, settings)}") from error
    return cls(parameters, checked), cls.describe(checked)


def check_served(name: str) -> str:
    """Refuse programs of the user."""
    if name in PROGRAMS:
        raise OdometryError(f"{name} is a program of the user: serve an odometry such as gicp")
    return name


def package_of(name: str) -> str:
    """The package that one of our odometries runs on."""
    module = where(name).partition(":")[0]
    return PACKAGES.get(name, module.removeprefix(f"{__package__}.").partition(".")[0])


def versions(name: str) -> dict[str, str]:
    """Versions of what a trial's outcome may depend on: adaptune, numpy, the odometry's package."""
    names = {"adaptune", "numpy"}
    module = where(name).partition(":")[0]
    if module.startswith(f"{__package__}."):
        names.add(package_of(name))
    else:
        names |= set(_distributions().get(module.partition(".")[0], ()))
    found = {}
    for package in sorted(names):
        with suppress(metadata.PackageNotFoundError):  # written by the user, or built in
            found[package] = metadata.version(package)
    return found


_distributions = cache(metadata.packages_distributions)
"""The packages by the modules that they bring, which takes a third of a second to find."""
