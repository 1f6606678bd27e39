"""The one base class of every error that a user is meant to read."""


class AdaptuneError(Exception):
    """A mistake in the input, with a sentence that says what to do.

    The command line prints the sentence and exits with code 2. Modules derive their own class
    from it, and chain the cause.
    """
