"""What both stages share: the vocabulary, the data, the black boxes and the error model."""


def __getattr__(name: str) -> str:
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import version

    return version("adaptune")
