"""What trials of a study need, and what is wrong with a study."""

import pytest

from adaptune._system.strict import ConfigurationError
from adaptune.odometry import InProcess
from offline.config import load_study
from offline.drive import TrialSetup


def setup_of(study, odometry=None, **settings):
    """The setup of a study, with another odometry or other settings of the offline stage."""
    offline = study.config.offline.model_copy(update=settings)
    config = study.config.model_copy(update={"offline": offline})
    return TrialSetup(config, odometry or study.odometry, study.sequences)


def made_of(odometry_class, study, made=None):
    """Make instances of a class with a study's settings, and append its odometries to a list."""

    def make(parameters=None, _sequence=None):
        odometry = odometry_class(parameters, study.odometry.settings)
        if made is not None:
            made.append(odometry)
        return InProcess(odometry)

    return make


def failure(file, *overrides):
    """The mistakes in a study."""
    with pytest.raises(ConfigurationError) as caught:
        load_study(file, overrides)
    return str(caught.value)
