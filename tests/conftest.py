"""What all tests share."""

from hypothesis import settings

# The same examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None)
settings.load_profile("estune")


def pytest_addoption(parser):
    parser.addoption("--endpoint", help="a rig of yours to be held to the protocol; it will move")
    parser.addoption("--rig", help="its name, where several answer at the endpoint")


def pytest_xdist_auto_num_workers(config):
    """Two at a time where all tests are run; those asked for by name run in this process."""
    return 2 if config.args_source is config.ArgsSource.TESTPATHS else 0
