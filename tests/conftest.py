"""Settings and options of all tests."""

from hypothesis import settings

# The same examples on every machine, however slow it is.
settings.register_profile("estune", derandomize=True, deadline=None)
settings.load_profile("estune")


def pytest_xdist_auto_num_workers(config):
    """Two workers for the whole suite; files named on the command line run in this process."""
    return 2 if config.args_source is config.ArgsSource.TESTPATHS else 0
