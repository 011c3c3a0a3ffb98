"""What all tests share."""

from hypothesis import settings

# The same examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None)
settings.load_profile("estune")
