"""For all tests: Hypothesis draws the same examples every time, and measures no durations (compilation is slow)."""

from hypothesis import settings

settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")
