"""A clock that stands still until somebody waits, so that tests of real time are exact."""


class SteppedClock:
    def __init__(self):
        self.seconds = 0.0

    def now(self):
        return self.seconds

    def sleep(self, seconds):
        self.seconds += max(seconds, 0.0)
