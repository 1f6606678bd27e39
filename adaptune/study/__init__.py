"""A study: what to tune and on which sequences, and the folder that keeps its results."""

from adaptune.study.config import StudyConfig
from adaptune.study.loading import read_study
from adaptune.study.mistakes import ConfigurationError
from adaptune.study.study import Study

__all__ = ["ConfigurationError", "Study", "StudyConfig", "read_study"]
