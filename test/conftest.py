"""Settings of every test."""

from hypothesis import settings

# The same examples on every run, and no timed tests: machines are busy.
settings.register_profile('rangeseg', deadline=None, derandomize=True)
settings.load_profile('rangeseg')
