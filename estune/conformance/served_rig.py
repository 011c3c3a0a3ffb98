"""The conformance suite on a rig that runs already; a plugin of pytest with its options."""

from pathlib import Path

import pytest

from estune.conformance.rig import RigConformance
from estune.errors import EstuneError
from estune.remote.security import OPEN, Security, read_security
from estune.remote.zenoh import connect


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds the options."""
    parser.addoption("--endpoint", required=True, help="endpoint of the rig; it will move")
    parser.addoption("--rig", help="its name, if several answer at the endpoint")
    parser.addoption("--security", type=Path, help="credentials file")


def pytest_sessionstart(session: pytest.Session) -> None:
    """Ends the session if no rig answers."""
    endpoint, name = (session.config.getoption(option) for option in ("--endpoint", "--rig"))
    try:
        connect(endpoint, name, security=_security(session.config)).close()
    except EstuneError as error:
        pytest.exit(f"nothing was tested: {error}", returncode=error.exit_code)


def _security(config: pytest.Config) -> Security:
    path = config.getoption("--security")
    return OPEN if path is None else read_security(path)


class TestServedRig(RigConformance):
    """Tests of the rig of the command line."""

    @pytest.fixture
    def endpoint(self, pytestconfig: pytest.Config) -> str:
        """Endpoint of the command line."""
        return str(pytestconfig.getoption("--endpoint"))

    @pytest.fixture
    def rig_name(self, pytestconfig: pytest.Config) -> str | None:
        """Name of the command line."""
        name: str | None = pytestconfig.getoption("--rig")
        return name

    @pytest.fixture
    def security(self, pytestconfig: pytest.Config) -> Security:
        """Credentials of the command line."""
        return _security(pytestconfig)
