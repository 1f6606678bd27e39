"""What both stages share: the vocabulary, the data, the black boxes and the error model."""

from importlib.metadata import version

__version__ = version("adaptune")
