"""`estune rig`: a reel on hardware as a rig; `estune export-controller`: its controller as C."""

import sys
import threading
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from estune.cli.values import security_from
from estune.errors import InvalidInput
from estune.remote import zenoh

if TYPE_CHECKING:
    from estune.hardware import HardwareRig

_Flag = Parameter(negative=(), show_default=False)


def rig(
    file: Path,
    /,
    *,
    listen: str = "tcp/127.0.0.1:0",
    ledger: Path | None = None,
    allow_remote: Annotated[bool, _Flag] = False,
    security: Path | None = None,
) -> None:
    """Serve a reel on hardware, or an emulated one, as a rig on the network, until Ctrl-C.

    Args:
        file: The rig's file, such as rig.toml.
        listen: Where to listen; port 0 picks a free one, which is printed.
        ledger: Where it is remembered which trials have run; beside the rig's file by default.
        allow_remote: Let other machines reach the rig; without --security, whoever reaches it can
            move it.
        security: File that says who may reach and command the rig; see docs/security.md.
    """
    from estune.hardware import HardwareRig, read_config  # noqa: PLC0415  slow to import

    config = read_config(file)
    book = ledger or file.with_suffix(".ledger")
    with HardwareRig(config) as hardware:
        for note in hardware.notes:
            print(f"estune: {note}", file=sys.stderr, flush=True)
        with (
            suppress(KeyboardInterrupt),
            zenoh.serve(
                *(hardware, listen),
                ledger=book,
                allow_remote=allow_remote,
                security=security_from(security),
            ) as server,
        ):
            print(f"rig {config.name} at {server.endpoint}", flush=True)
            print(
                f"the reel has no power before the first trial; tune it with: estune tune "
                f"{server.endpoint}    stop with Ctrl-C",
                flush=True,
            )
            threading.Thread(target=_close_after, args=(hardware, server), daemon=True).start()
            server.wait()
            hardware.describe()  # says why its loop has ended, if that is why we are here


def _close_after(hardware: "HardwareRig", server: zenoh.RigServer) -> None:
    """Lets a rig whose loop has failed vanish from the network, and its process end."""
    hardware.wait()
    server.close()


def export_controller(
    source: str,
    /,
    *,
    out: Path | None = None,
    c: Annotated[bool, _Flag] = False,
    start: Annotated[bool, _Flag] = False,
    schedule: Path | None = None,
    folder: Path | None = None,
) -> None:
    """Write a controller with its gains and settings as one C file for firmware.

    Args:
        source: A run, by its name or folder, or a rig's file such as rig.toml.
        out: The file to write; estune_pidf.c by default.
        c: Write C, the only form there is.
        start: The gains the run began from, instead of those it found.
        schedule: A gain schedule (JSON, as of a sweep) to be written beside it as a C header,
            estune_schedule.h.
        folder: Folder that runs are kept in.
    """
    from estune import api  # noqa: PLC0415  slow to import
    from estune.cli.runs import find_run  # noqa: PLC0415  as above
    from estune.hardware import controller_source, read_config  # noqa: PLC0415  as above
    from estune.hardware.schedule_file import (  # noqa: PLC0415  as above
        read_schedule,
        schedule_header,
    )
    from estune.run.export import replace_file  # noqa: PLC0415  as above

    if not c:
        raise InvalidInput("say in which form to write the controller: --c")
    if source.endswith(".toml"):
        description = read_config(source).describe()
        settings, gains = description.controller, description.gains
    else:
        result = api.load(find_run(source, folder or Path(api.RUNS)))
        settings, gains = result.rig.controller, result.start_gains if start else result.gains
    path = out or Path("estune_pidf.c")
    header = None if schedule is None else schedule_header(read_schedule(schedule))
    try:
        replace_file(path, controller_source(settings, gains).encode())
        print(f"controller at {settings.sampling_Hz:g} Hz, {gains}: {path}")
        if header is not None:
            path = path.with_name("estune_schedule.h")
            replace_file(path, header.encode())
            print(f"gain schedule: {path}")
    except OSError as error:
        raise InvalidInput(f"{path}: {error.strerror or error}; give another --out") from error
