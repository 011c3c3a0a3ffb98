"""The snippets of README.md and docs/ are tests."""

from tests.support_snippets import SNIPPETS

pytest_collect_file = SNIPPETS.pytest()
