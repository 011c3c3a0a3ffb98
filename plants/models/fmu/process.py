"""The process of one FMU: `python -m plants.models.fmu.process DESCRIPTOR`, by FMPy."""

import shutil
import signal
import sys
import tempfile
import zipfile
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

from plants.models.fmu.step import ANSWER, REQUEST, FmuFacts

Step = Callable[[float, float], float]
"""(effort, time step) -> measurement after it."""


class UnusableFmu(Exception):
    """The file is no FMU that can be used; the message says why."""


class FmuUnit:
    """One instance of a unit, reset for each trial: some crash after a thousand instantiations."""

    def __init__(self, file: str, input_: str, output: str, folder: str) -> None:
        from fmpy import extract, read_model_description  # noqa: PLC0415  an optional dependency
        from fmpy.fmi2 import FMU2Slave  # noqa: PLC0415
        from fmpy.fmi3 import FMU3Slave  # noqa: PLC0415

        about = read_model_description(file)
        if about.coSimulation is None:
            raise UnusableFmu("it is for model exchange only; export it for co-simulation")
        self.version, self.tool = about.fmiVersion, about.generationTool or "an unknown tool"
        kinds = {"2.0": (FMU2Slave, "linux64"), "3.0": (FMU3Slave, "x86_64-linux")}
        if self.version not in kinds:
            raise UnusableFmu(f"it is of FMI {self.version}; export it as FMI 2 or 3")
        kind, platform = kinds[self.version]
        _check_platform(file, f"binaries/{platform}/")
        self._input, self._output = (_variable(about, name) for name in (input_, output))
        self._unit: Any = kind(
            guid=about.guid,
            unzipDirectory=extract(file, folder),
            modelIdentifier=about.coSimulation.modelIdentifier,
            instanceName="plant",
        )
        self._unit.instantiate()
        events = bool(getattr(about.coSimulation, "hasEventMode", False))
        self.extra_step = "Simulink" in self.tool and not (self.version == "3.0" and events)
        self._time_s = 0.0
        self._begin()
        self.initial = self._get()

    def step(self, effort: float, dt_s: float) -> float:
        """The measurement after a step; a step of zero begins anew."""
        if dt_s == 0.0:
            self._unit.reset()
            self._begin()
            return self._get()
        if self.version == "2.0":
            self._unit.setReal([self._input], [effort])
            self._unit.doStep(self._time_s, dt_s)
        else:
            self._unit.setFloat64([self._input], [effort])
            _, terminated, _, _ = self._unit.doStep(self._time_s, dt_s)
            if terminated:
                raise UnusableFmu(f"it ended the simulation at {self._time_s:g} s")
        self._time_s += dt_s
        return self._get()

    def _begin(self) -> None:
        self._time_s = 0.0
        if self.version == "2.0":
            self._unit.setupExperiment(startTime=0.0)
            self._unit.enterInitializationMode()
        else:
            self._unit.enterInitializationMode(startTime=0.0)
        self._unit.exitInitializationMode()

    def _get(self) -> float:
        get = self._unit.getReal if self.version == "2.0" else self._unit.getFloat64
        return float(get([self._output])[0])


def _check_platform(file: str, folder: str) -> None:
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
    if not any(name.startswith(folder) and name.endswith(".so") for name in names):
        had = sorted({name.split("/")[1] for name in names if name.startswith("binaries/")})
        raise UnusableFmu(
            f"it has no library for this machine in {folder} (it has {', '.join(had) or 'none'}); "
            "export it for 64-bit Linux"
        )


def _variable(about: Any, name: str) -> int:
    known = {variable.name: variable.valueReference for variable in about.modelVariables}
    if name not in known:
        listed = ", ".join(list(known)[:12])
        raise UnusableFmu(f"it has no variable {name}; it has {listed}")
    return int(known[name])


def serve(pipe: "Connection[Any, Any]", step: Step) -> None:
    """Answers until the other end is closed."""
    while True:
        try:
            request = pipe.recv_bytes()
        except EOFError:
            return
        try:
            answer = ANSWER.pack(1, step(*REQUEST.unpack(request)))
        except Exception as error:  # noqa: BLE001  whatever the unit or FMPy raises ends the trial
            answer = ANSWER.pack(0, 0.0) + " ".join(str(error).split()).encode()
        pipe.send_bytes(answer)


def main(descriptor: int) -> int:
    """Loads the unit that the first message names, and executes its steps."""
    # Ctrl-C in a terminal reaches this process, too; its parent ends it by closing the pipe.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    pipe: Connection[Any, Any] = Connection(descriptor)
    file, input_, output = pipe.recv()
    folder = tempfile.mkdtemp(prefix="estune-fmu-")
    try:
        unit = FmuUnit(file, input_, output, folder)
        pipe.send(FmuFacts(unit.version, unit.tool, unit.extra_step, unit.initial))
        serve(pipe, unit.step)
    except ModuleNotFoundError as error:
        pipe.send(f"FMUs need {error.name}; install it with: pip install 'estune[fmu]'")
    except Exception as error:  # noqa: BLE001  a damaged file can fail anywhere
        why = " ".join(str(error).split()) or type(error).__name__
        pipe.send(why if isinstance(error, UnusableFmu) else f"no FMU that can be loaded: {why}")
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
