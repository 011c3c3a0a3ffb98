"""`estune serve`: a simulated plant served as a rig."""

import os
import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from estune.cli.values import Flag, OptionalText, Values, security_from, settings_from
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.remote.ledger import LEDGER
from estune.remote.zenoh.endpoints import check_listener
from estune.run.targets import load
from estune.support.log_lines import LogFormat, begin_logging
from estune.support.sqlite import has_writer
from estune.trial import Rig


def serve(
    plant: str = "plants:reference_reel",
    /,
    *,
    listen: str = "tcp/127.0.0.1:0",
    name: str = "reel",
    seed: int = 0,
    pace: float = 0.0,
    set_: Annotated[Values, Parameter(name="--set")] = (),
    ledger: OptionalText = "",
    allow_remote: Flag = False,
    security: Path | None = None,
    log_format: LogFormat = "text",
    stop_on_eof: Flag = False,
) -> None:
    """Serve a simulated reel, or any plant, as a rig on the network, until Ctrl-C.

    Args:
        plant: The plant: a model file such as reel.toml, or module:attribute.
        listen: Address to listen at; port 0 picks a free one, which is printed.
        name: Name of the rig.
        seed: Seed of the measurement noise.
        pace: Wall-clock seconds per simulated second: 1 is real time, 0 is as fast as possible.
        set_: A setting of the plant, as cable_length_m=1.1 or tension_N=20; repeat for more.
        ledger: File of the trials that have run; rigs/NAME.ledger by default. "memory" keeps
            them only until the server ends.
        allow_remote: Let other machines reach the rig; without --security, any of them can move
            it.
        security: Credentials file: the users that may reach and command the rig.
        log_format: JSON lines or text, on standard error; auto is text on a terminal.
        stop_on_eof: Stop when standard input is closed, too: when a parent process has ended.
    """
    begin_logging(log_format)
    credentials = security_from(security)
    check_listener(listen, credentials, allow_remote=allow_remote)
    rig = _rig(load(plant, settings_from(set_)), plant, name=name, seed=seed, pace=pace)
    book = None if ledger == "memory" else Path(ledger or f"rigs/{name}.ledger")
    if book is not None and has_writer(book, LEDGER):
        raise RigError(
            f"the ledger {book} is that of another server; serve a second rig beside it with "
            f"another name, such as --name {name}-2, or give its own --ledger"
        )
    with (
        suppress(KeyboardInterrupt),
        zenoh.serve(
            *(rig, listen),
            ledger=book,
            allow_remote=allow_remote,
            security=credentials,
        ) as server,
    ):
        print(f"rig {name} at {server.endpoint}", flush=True)
        print(f"tune it with: estune tune {server.endpoint}    stop with Ctrl-C", flush=True)
        if stop_on_eof:
            threading.Thread(target=_close_at_eof, args=(server,), daemon=True).start()
        server.wait()
    rig.close()


def _rig(plant: Any, reference: str, **settings: Any) -> Rig:
    if not hasattr(plant, "rig"):
        raise InvalidInput(
            f"{reference} is no plant: it has no rig(); make one with plants.linear_plant or "
            "plants.python_plant"
        )
    made: Rig = plant.rig(**settings)
    return made


def _close_at_eof(server: zenoh.RigServer) -> None:
    # Unbuffered: a thread inside a buffered reader would abort the interpreter at its end.
    while os.read(sys.stdin.fileno(), 4096):
        pass
    server.close()
