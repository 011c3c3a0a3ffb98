"""What all tests share."""

from hypothesis import settings

# The same examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None)
settings.load_profile("estune")


def pytest_addoption(parser):
    parser.addoption("--endpoint", help="a rig of yours to be held to the protocol; it will move")
    parser.addoption("--rig", help="its name, where several answer at the endpoint")
