"""Nothing is in the product that no command, entry point or public name reaches."""

from tests.reached import PACKAGES, modules, reached, unreached


def test_every_definition_of_the_product_is_reached():
    assert not unreached(), "see: ./dev python -m tests.reached"


def test_every_module_of_the_product_is_reached():
    found = {module for module, _ in reached()}
    within = {name for name in modules() if any(f.startswith(f"{name}.") for f in found)}
    assert not set(modules()) - found - within - set(PACKAGES)
