"""Lists the experiments, each with its question: ./dev python -m experiments."""

import ast
import re
from functools import cache
from pathlib import Path

_PRINTS_RESULTS = re.compile(r"def main\(.*print_results\(", re.DOTALL)


@cache
def experiments() -> dict[str, str]:
    """Docstrings of the modules and packages that can be run and print results, by name."""
    folder = Path(__file__).parent
    listed = {}
    for file in sorted([*folder.glob("*.py"), *folder.glob("*/__main__.py")]):
        text = file.read_text("utf-8")
        if _PRINTS_RESULTS.search(text):
            name = file.parent.name if file.stem == "__main__" else file.stem
            listed[name] = ast.get_docstring(ast.parse(text)) or ""
    return listed


def main() -> None:
    """Prints them."""
    for name, text in experiments().items():
        print(f"{name:22} {text.partition(chr(10))[0]}")


if __name__ == "__main__":
    main()
