"""A client process: one tuning, started or resumed, over a disturbed link.

    python -m experiments.chaos.client JSON

Its exit code is that of `estune tune` or `estune resume`; it prints errors on standard error.
"""

import json
import signal
import sys

from estune import api
from estune.core.gains import Gains
from estune.errors import EstuneError
from estune.remote.zenoh.rig_connection import RigConnection
from estune.run.journal import FILE_NAME
from experiments.chaos.errand import Errand
from experiments.chaos.mischief import Mischief, disturbed

INTERRUPTED = 130


def tune(errand: Errand) -> None:
    """Tunes, or resumes the run of an earlier client."""
    if (errand.journal / FILE_NAME).exists():
        api.resume(errand.journal, watch=None)
        return
    api.tune(
        errand.endpoint,
        rig=errand.rig,
        run=errand.run,
        folder=errand.folder,
        tuner=errand.tuner,
        start=Gains(*errand.start),
        trials=errand.trials,
        watch=None,
    )


def main(text: str) -> int:
    """Executes the errand; returns the exit code."""
    # Shells let what they start in the background ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    errand = Errand(**json.loads(text))
    mischief = Mischief(errand.endpoint, errand.seed)
    try:
        # All commands pass through this method.
        RigConnection.ask = disturbed(RigConnection.ask, mischief)  # type: ignore[method-assign]
        tune(errand)
    except EstuneError as error:
        print(error, file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        mischief.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
