"""Tests the rig at an endpoint; it moves. Options of pytest are passed on.

python -m estune.conformance --endpoint tcp/127.0.0.1:7447 [--rig NAME] [--security FILE]
"""

import os
import sys

import pytest

SUITE = "estune.conformance.served_rig"

if __name__ == "__main__":
    if {"-h", "--help"} & set(sys.argv):
        print(__doc__)
        raise SystemExit
    # No settings of the folder that it happens to be run in.
    own = [
        "-c",
        os.devnull,
        "--rootdir",
        os.curdir,
        "--noconftest",
        "-p",
        "no:cacheprovider",
        "-p",
        SUITE,
    ]
    raise SystemExit(pytest.main([*own, "--pyargs", SUITE, *sys.argv[1:]]))
