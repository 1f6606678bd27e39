"""The odometries by name, imported when they are asked for."""

from importlib import import_module
from importlib.metadata import entry_points

from adaptune.odometry.base import Odometry, OdometryError
from adaptune.space import nearest

ENTRY_POINTS = "adaptune.odometries"
"""Group in which other packages announce their odometries, each by its name."""

BOXES = {
    "ct_icp": "adaptune.odometry.evalio:CtIcp",
    "evalio_kiss_icp": "adaptune.odometry.evalio:KissIcp",
    "form": "adaptune.odometry.evalio:Form",
    "genz_icp": "adaptune.odometry.evalio:GenzIcp",
    "gicp": "adaptune.odometry.gicp:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "loam": "adaptune.odometry.evalio:Loam",
    "mad_icp": "adaptune.odometry.evalio:MadIcp",
    "ndt": "adaptune.odometry.ndt:KeyframeNdt",
    "vgicp": "adaptune.odometry.vgicp:KeyframeVgicp",
}


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
    path = BOXES.get(name) or (name if ":" in name else None)
    if path is None:
        announced = {point.name: point.value for point in entry_points(group=ENTRY_POINTS)}
        if name not in announced:
            help_ = nearest(name, [*BOXES, *announced])
            raise OdometryError(
                f"there is no odometry {name!r}: {help_} (a class of your own is module:Class)"
            )
        path = announced[name]
    module, _, attribute = path.partition(":")
    try:
        found = getattr(import_module(module), attribute)
    except ImportError as error:
        raise OdometryError(
            f"{name}: cannot import {module} ({error}); install it, or name its folder in "
            f"PYTHONPATH"
        ) from error
    except AttributeError as error:
        raise OdometryError(f"{name}: {module} has no {attribute or 'class'}") from error
    if not (isinstance(found, type) and issubclass(found, Odometry)):
        raise OdometryError(f"{name}: is not a class derived from adaptune.odometry.Odometry")
    if lacking := [key for key in ("space", "live") if not hasattr(found, key)]:
        raise OdometryError(f"{name}: the class has no attribute {' and no '.join(lacking)}")
    return found
