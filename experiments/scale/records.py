"""A diagnosis of many records of 10 000 samples: CPU time, memory, and whether it is right.

Records are closed-loop trials of the reference reel with dry friction, at gains of 0.7 to 1.1
times its own, with steps, triangles and chirps in turn. Each size is diagnosed in a process of its
own; its memory is the peak of the whole process, records included.
"""

import multiprocessing
import resource
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import numpy as np

import plants
from estune.core.gains import Gains
from estune.trial import TrialRecord, TrialRequest
from estune.trial.profiles import AnyProfile, ChirpProfile, StepProfile, TriangleProfile
from plants.effects import CoulombFriction

SAMPLES = 10_000
FRICTION_Nm = 0.02


class DiagnosisCosts(NamedTuple):
    """Costs of a diagnosis.

    Attributes:
        records: Number of records.
        cpu_s: CPU time of the diagnosis, compilers not counted, s.
        memory_MB: Peak memory of its process.
        is_right: 1 where dry friction alone is named, else 0.
        friction_off: Relative error of its size.
    """

    records: int
    cpu_s: float
    memory_MB: float
    is_right: float
    friction_off: float


def trials(records: int) -> Iterator[TrialRecord]:
    """Trials of the reel with friction, no two alike."""
    rig = (plants.reference_reel() + CoulombFriction(torque_Nm=FRICTION_Nm)).rig()
    about = rig.describe()
    own = about.gains or Gains(0.4, 12.0, 0.01, 0.03)
    duration_s = SAMPLES / about.controller.sampling_Hz
    for n in range(records):
        share = 0.5 + 0.5 * np.sin(n)
        size_N = 4.0 + 6.0 * share
        profiles: tuple[AnyProfile, ...] = (
            StepProfile(15.0, size_N, 2.0, duration_s),
            TriangleProfile(18.0, size_N, 3.0 + share, duration_s, 0.5),
            ChirpProfile(18.0, 0.5 * size_N, 0.2, 3.0 + 4.0 * share, duration_s, 0.5),
        )
        scale = 0.7 + 0.4 * (n % 5) / 4.0
        gains = Gains(own.P * scale, own.I * scale, own.D * scale, own.setpoint_filter_s)
        yield rig.run(TrialRequest("scale", n, gains, profiles[n % 3]))


def diagnose(records: int) -> DiagnosisCosts:
    """Diagnoses so many records in this process."""
    measured = list(trials(records))
    begun = time.process_time()
    found = plants.explain(plants.reference_reel(), measured)
    cpu_s = time.process_time() - begun
    named = {effect.name: effect for effect in found.effects}
    off = 1.0
    if CoulombFriction.name in named:
        fitted = named[CoulombFriction.name].parameters["torque_Nm"].value
        off = abs(fitted / FRICTION_Nm - 1.0)
    return DiagnosisCosts(
        records,
        cpu_s,
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
        float(found.verdict == "named" and set(named) == {CoulombFriction.name}),
        off,
    )


def measure_diagnosis(records: int) -> DiagnosisCosts:
    """Diagnoses so many records in a new process."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(diagnose, records).result()
