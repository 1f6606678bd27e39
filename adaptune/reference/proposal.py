"""Which length of sub-trajectories to propose for a study, given how accurate its reference is."""

from adaptune.live.hop import LENGTHS as HOPS
from adaptune.live.own_error import OwnError
from adaptune.metrics import travelled
from adaptune.reference.given import MeasuredReference
from adaptune.trajectory import Trajectory

LENGTHS = {25.0: 8, 10.0: 8, 5.0: 1.4, 2.0: 2}
"""Metres of a sub-trajectory, and how many of them the path of the test must hold: over short ones,
the noise of the reference counts too much."""
LONGER = (5.0, 10.0, 25.0, 50.0, 100.0)
"""Metres to choose from where the first of `LENGTHS` that fits is too short after all."""
FEWEST = 1.4
"""How many of them the path of the test must hold then."""
SECONDS = 2.0
"""A sub-trajectory lasts as long at least, up to the greatest of `LENGTHS`: who is fast often has
a reference of GPS, which is noisy."""
NOISY = 0.5
"""Percent by which a reference may be wrong, as far as registrations can tell."""
TRAINING = 0.6
"""Share of a recording's duration that is proposed for training, before the test."""


def proposed_sub_trajectory(
    reference: Trajectory, measured: MeasuredReference | None = None
) -> float:
    """Metres of the sub-trajectories that a study of a recording alone should judge by.

    Parameters
    ----------
    reference
        Of the recording.
    measured
        Registrations along it, if its scans were registered.

    Returns
    -------
    float
        The first of `LENGTHS` for which the test's part of the path is long enough, 1 m if none is,
        or a longer one if that does not last `SECONDS`. Where the reference is too noisy for it,
        the first longer one that fits and for which it is not; where it is for all, the longest
        that fits, up to the greatest of `LENGTHS`.
    """
    path, seconds = _tested(reference)
    usual = next((length for length, n in LENGTHS.items() if n * length <= path), 1.0)
    least = min(SECONDS * path / seconds, max(LENGTHS)) if seconds else 0.0
    fit = [usual, *(length for length in LONGER if length > usual and FEWEST * length <= path)]
    usual = next((length for length in fit if length >= least), fit[-1])
    if measured is None or not is_noisy(measured.error(usual)):
        return usual
    for length in (length for length in fit if length > usual):
        error = measured.error(length)
        if error is not None and not is_noisy(error):
            return length
    return max(length for length in fit if length <= max(LENGTHS))


def _tested(reference: Trajectory) -> tuple[float, float]:
    """Metres and seconds of the path that is proposed for the test."""
    first, last = reference.stamps[[0, -1]]
    tested = reference.stamps >= first + TRAINING * (last - first)
    seconds = float(last - reference.stamps[tested][0]) * 1e-9
    return float(travelled(reference.T_world_sensor[tested])[-1]), seconds


def is_noisy(error: OwnError | None) -> bool:
    """Whether a reference is surely wrong by more than `NOISY`; False where nothing is known."""
    return error is not None and error.low > NOISY


def accuracy_words(measured: MeasuredReference, *lengths: float) -> str:
    """How wrong a reference is over some metres, in words."""
    told = [_error_words(measured, length) for length in dict.fromkeys(lengths)]
    if not (known := [words for words in told if words]):
        return f"its error over {lengths[0]:g} m cannot be measured: too few scans agree"
    return f"wrong by {', '.join(known)}, as registrations of scans tell"


def _error_words(measured: MeasuredReference, length: float) -> str:
    error = measured.error(length)
    if error is None:
        return ""
    most = "at most " if length < HOPS[0] else ""
    return f"{most}{error.mean:.2g} % ({error.low:.2g}-{error.high:.2g}) over {length:g} m"


def advice(measured: MeasuredReference, reference: Trajectory) -> str:
    """What to do about a reference that is too noisy for the usual length; empty if it is not."""
    if not is_noisy(measured.error(proposed_sub_trajectory(reference))):
        return ""
    length = proposed_sub_trajectory(reference, measured)
    less = "sets that differ by less cannot be told apart"
    if is_noisy(measured.error(length)):
        return f"{less}, at no length that fits: use `reference: estimated`"
    return f"{less}: use a sub_trajectory of {length:g} m, or `reference: estimated`"
