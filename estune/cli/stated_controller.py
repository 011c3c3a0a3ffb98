"""What a user states of the controller that ran: gains as text, or a file of them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field

from estune.cli.values import numbers_from
from estune.core.gains import GAIN_NAMES, Gains
from estune.errors import InvalidInput
from estune.support.toml_file import TomlTable, read_toml, validate

SHORT = {"F": "setpoint_filter_s"}


class RanTable(TomlTable):
    """Gains that ran; those left out are zero."""

    P: Annotated[float, Field(gt=0.0)]
    I: Annotated[float, Field(ge=0.0)] = 0.0
    D: Annotated[float, Field(ge=0.0)] = 0.0
    setpoint_filter_s: Annotated[float, Field(ge=0.0)] = 0.0


class StatedController(NamedTuple):
    """What is stated of a controller.

    Attributes:
        gains: Of all logs, or by the log's name; None where nothing is stated.
        derivative_filter_s: Time constant of the derivative filter; None where nothing is stated.
    """

    gains: Gains | Mapping[str, Gains] | None = None
    derivative_filter_s: float | None = None


def stated_controller(text: str | None) -> StatedController:
    """What `--gains` states: `P=1.2,I=40,D=0.01,F=0.005`, or the path of a TOML file.

    The file is a rig's, or one whose table `[gains]` has the gains, or a table for each log, such
    as `[gains."run1.csv"]`.

    Raises:
        InvalidInput: it cannot be read, or has no gains.
    """
    if text is None:
        return StatedController()
    if text.endswith(".toml"):
        return _of_file(Path(text))
    given = {SHORT.get(name, name): value for name, value in numbers_from(text.split(",")).items()}
    unknown = set(given) - set(GAIN_NAMES)
    if unknown or "P" not in given:
        wrong = f"there is no {', '.join(sorted(unknown))}" if unknown else "P is missing"
        raise InvalidInput(f"--gains {text}: {wrong}; write P=2,I=0.5,D=0,F=0, or a TOML file")
    return StatedController(Gains(*(given.get(name, 0.0) for name in GAIN_NAMES)))


def _of_file(path: Path) -> StatedController:
    data = read_toml(path)
    tables = data.get("gains")
    if not isinstance(tables, dict) or not tables:
        raise InvalidInput(f"{path} has no table [gains] with P, I, D and setpoint_filter_s")
    if all(isinstance(table, dict) for table in tables.values()):
        named = {log: _gains(table, f"{path}: gains.{log}") for log, table in tables.items()}
        return StatedController(named)
    if "driver" not in data:
        return StatedController(_gains(tables, f"{path}: gains"))
    from estune.hardware.tables import ControllerTable  # noqa: PLC0415  slow to import

    controller = validate(ControllerTable, data.get("controller", {}), f"{path}: controller")
    own: Any = controller  # mypy does not know the fields of a table made from settings
    return StatedController(_gains(tables, f"{path}: gains"), own.derivative_filter_s)


def _gains(table: dict[str, Any], source: str) -> Gains:
    return Gains(**validate(RanTable, table, source).model_dump())
