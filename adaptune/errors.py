"""The one base class of every error that a user is meant to read, and others in a line."""

import traceback


class AdaptuneError(Exception):
    """A mistake in the input, with a sentence that says what to do.

    The command line prints the sentence and exits with code 2. Modules derive their own class
    from it, and chain the cause.
    """


def in_a_line(error: BaseException) -> str:
    """An exception in a line, with the place where it was raised; ours are told as they are."""
    if isinstance(error, AdaptuneError):
        return str(error)
    what = "".join(traceback.format_exception_only(error)).strip()
    raised = traceback.extract_tb(error.__traceback__)
    return f"{what} ({raised[-1].filename}, line {raised[-1].lineno})" if raised else what
