"""Records of machines that share no code with the models, as `explain` takes them."""

import pytest

from experiments import hidden_machines
from experiments.hidden_machines import machine
from experiments.hidden_machines.machine import NoCompiler
from experiments.hidden_scores import measurement, model


def drawn(seed, variant, effect=None):
    """The owner's model of a machine, and its records."""
    case, _ = hidden_machines.draw(seed, variant, effect)
    return model(case), [measurement(record) for record in case.records]


def skip_without_compiler():
    """Skips a test where hidden machines cannot be compiled."""
    try:
        machine.library()
    except NoCompiler as error:
        pytest.skip(str(error))
