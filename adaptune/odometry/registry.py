"""The odometries by name, imported when they are asked for."""

from importlib import metadata
from typing import Any

from adaptune import plugins
from adaptune.odometry.base import Odometry, OdometryError

ENTRY_POINTS = "adaptune.odometries"
"""Group in which other packages announce their odometries, each by its name."""

BOXES = {
    "ct_icp": "adaptune.odometry.evalio:CtIcp",
    "dlio": "adaptune.odometry.evalio:Dlio",
    "evalio_kiss_icp": "adaptune.odometry.evalio:KissIcp",
    "form": "adaptune.odometry.evalio:Form",
    "genz_icp": "adaptune.odometry.evalio:GenzIcp",
    "gicp": "adaptune.odometry.gicp:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "lio_sam": "adaptune.odometry.evalio:LioSam",
    "loam": "adaptune.odometry.evalio:Loam",
    "mad_icp": "adaptune.odometry.evalio:MadIcp",
    "ndt": "adaptune.odometry.ndt:KeyframeNdt",
    "rko_lio": "adaptune.odometry.rko_lio:RkoLio",
    "vgicp": "adaptune.odometry.vgicp:KeyframeVgicp",
}

_PACKAGES = {"gicp": "small_gicp", "kiss_icp": "kiss-icp", "ndt": "open3d", "vgicp": "small_gicp"}
"""Packages that odometries of ours run on, where their module is not named as those are."""


def versions(box: type[Any]) -> dict[str, str]:
    """Versions of what a trial's outcome may depend on: adaptune, numpy, the odometry's package."""
    names = {"adaptune", "numpy"}
    package, _, module = box.__module__.rpartition(".")
    if package == __package__:
        names.add(_PACKAGES.get(module, module))
    else:
        top = box.__module__.partition(".")[0]
        names |= set(metadata.packages_distributions().get(top, ()))
    found = {}
    for name in sorted(names):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue  # written by the user, or built in
    return found


PROGRAMS = {
    "command": "adaptune.odometry.command:Command",
    "process": "adaptune.odometry.process:Process",
}
"""Programs of the user's, which are no Python classes."""


def box_class(name: str) -> type[Odometry]:
    """Class of an odometry.

    Parameters
    ----------
    name
        One of `BOXES`, one that an installed package announces in the entry-point group
        ``adaptune.odometries``, or ``module:Class``.

    Raises
    ------
    OdometryError
        Naming the nearest odometry there is, or telling why the class cannot be used.
    """
    try:
        found = plugins.load(name, "odometry", BOXES | PROGRAMS, ENTRY_POINTS, "Class")
    except plugins.PluginError as error:
        raise OdometryError(str(error)) from error
    if not (isinstance(found, type) and issubclass(found, Odometry)):
        raise OdometryError(f"{name}: is not a class derived from adaptune.odometry.Odometry")
    if lacking := [key for key in ("space", "live") if not hasattr(found, key)]:
        raise OdometryError(f"{name}: the class has no attribute {' and no '.join(lacking)}")
    return found
