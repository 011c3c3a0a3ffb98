"""Public names that are imported at their first use."""

import subprocess
import sys

import pytest

import estune
import estune.hardware
import plants


@pytest.mark.parametrize("package", [estune, plants, estune.hardware])
def test_dir_lists_every_lazy_export_and_each_resolves(package):
    assert set(package.__all__) <= set(dir(package))
    assert all(getattr(package, name) is not None for name in package.__all__)
    assert "__path__" in dir(package)


def test_unknown_name_raises_attribute_error():
    with pytest.raises(AttributeError, match="module 'estune' has no attribute 'tuna'"):
        _ = estune.tuna


def test_import_of_package_imports_none_of_its_modules():
    script = (
        "import sys, estune, plants; dir(estune); "
        "assert not {'estune.api', 'plants.models', 'numpy'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
