"""`python -m estune`: the command line without its script.

Python puts the working directory first on the path of `-m`. It is moved to the end, where the
script has it, so that a `plants.py` of the user does not hide the installed package.
"""

import sys
from pathlib import Path

if sys.path and Path(sys.path[0]).resolve() == Path.cwd():
    del sys.path[0]  # `main` appends it

from estune.cli import main

if __name__ == "__main__":
    main()
