"""The odometries by name, imported when they are asked for."""

from importlib import import_module

from adaptune.odometry.base import Odometry, OdometryError
from adaptune.space import nearest

BOXES = {
    "gicp": "adaptune.odometry.gicp:KeyframeGicp",
    "kiss_icp": "adaptune.odometry.kiss_icp:Kiss",
    "ndt": "adaptune.odometry.ndt:KeyframeNdt",
}


def box_class(name: str) -> type[Odometry]:
    """Class of the odometry called `name`.

    Raises
    ------
    OdometryError
        Naming the nearest odometry there is.
    """
    if name not in BOXES:
        raise OdometryError(f"there is no odometry {name!r}: {nearest(name, BOXES)}")
    module, _, cls = BOXES[name].partition(":")
    found: type[Odometry] = getattr(import_module(module), cls)
    return found
