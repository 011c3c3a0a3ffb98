"""`estune serve-hardware` and `estune export-controller`: a real reel, and its controller as C."""

import math
import sys
import threading
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

from estune.cli.values import Flag, security_from
from estune.errors import InvalidInput, RigError
from estune.remote import zenoh
from estune.support.log_lines import LogFormat, begin_logging
from estune.support.plugins import load_plugin, plugins

if TYPE_CHECKING:
    from estune.hardware import HardwareRig
    from estune.hardware.black_box import BlackBox
    from estune.hardware.trial_board.rig import BoardRig


def serve_hardware(
    file: Path | None = None,
    /,
    *,
    listen: str = "tcp/127.0.0.1:0",
    ledger: Path | None = None,
    allow_remote: Flag = False,
    security: Path | None = None,
    log_format: LogFormat = "text",
    http_port: int | None = None,
    example: Flag = False,
    hidden: str | None = None,
) -> None:
    """Serve a reel on hardware, or an emulated one, as a rig on the network, until Ctrl-C.

    Args:
        file: The rig's file (TOML), such as my-rig.toml; --example prints one.
        listen: Address to listen at; port 0 picks a free one, which is printed.
        ledger: File of the trials that have run; beside the rig's file by default.
        allow_remote: Let other machines reach the rig; without --security, any of them can move
            it.
        security: Credentials file: the users that may reach and command the rig.
        log_format: JSON lines or text, on standard error; auto is text on a terminal.
        http_port: Port of 127.0.0.1 that serves /metrics, /health and /ready.
        example: Print a complete rig file, of an emulated reel, and exit.
        hidden: With --example, an effect that the emulated machine has and its model lacks:
            coulomb, cogging, ripple or gravity.
    """
    if example:
        print(_example(hidden), end="")
        return
    if hidden is not None:
        raise InvalidInput("--hidden is for an emulated machine; give --example with it")
    if file is None:
        raise InvalidInput("give the rig's file; for one to begin from, use --example")
    from estune.cli.rig_metrics import rig_metrics  # noqa: PLC0415  slow to import
    from estune.daemon.notifications import Notifier  # noqa: PLC0415  as above
    from estune.hardware import HardwareRig, read_config  # noqa: PLC0415  slow to import
    from estune.hardware.black_box import black_box  # noqa: PLC0415  as above
    from estune.hardware.real_time import prioritised  # noqa: PLC0415  as above
    from estune.hardware.trial_board.rig import DRIVER, BoardRig  # noqa: PLC0415  as above

    begin_logging(log_format)
    config = read_config(file)
    rig = BoardRig if config.driver.use == DRIVER else HardwareRig
    with (
        ExitStack() as ended,
        rig(config) as hardware,
        suppress(KeyboardInterrupt),
        black_box(hardware, file, config.black_box) as box,
        rig_metrics(hardware, box, http_port) as metrics,
        # The threads that take a stop from the network are started from here on.
        prioritised(config.real_time.server_priority) as refused,
        zenoh.serve(
            *(hardware, listen),
            ledger=ledger or file.with_suffix(".ledger"),
            allow_remote=allow_remote,
            security=security_from(security),
            heard=metrics.hear,
        ) as server,
    ):
        for note in filter(None, (*hardware.notes, refused)):
            print(f"estune: {note}", file=sys.stderr, flush=True)
        print(f"rig {config.name} at {server.endpoint}", flush=True)
        print(
            f"the reel has no power before the first trial; tune it with: estune tune "
            f"{server.endpoint}    stop with Ctrl-C",
            flush=True,
        )
        watch = threading.Thread(target=_close_after, args=(hardware, server, box), daemon=True)
        watch.start()
        ended.callback(watch.join)  # the interpreter must not shut down while it is inside Zenoh
        service = Notifier()
        service.notify(READY=1, STATUS=f"rig {config.name} at {server.endpoint}: no power, idle")
        while not server.wait(0.3 * (service.watchdog_s or math.inf)):
            hardware.describe()
            service.notify(WATCHDOG=1)
        hardware.describe()  # raises the failure of its control loop, if that ended the wait


def _example(hidden: str | None) -> str:
    examples = plugins("estune.examples")
    if "rig" not in examples:
        raise InvalidInput("no installed package offers an example; reinstall estune")
    return str(load_plugin(examples["rig"])(hidden))


def _close_after(
    hardware: "HardwareRig | BoardRig", server: zenoh.RigServer, box: "BlackBox | None"
) -> None:
    """Closes the server once the control loop of its rig, or its board, has failed."""
    hardware.wait()
    if server.closed:
        return
    try:
        hardware.describe()
    except RigError as error:
        server.fail(str(error))
        if box is not None:
            box.close(str(error))
    server.close()


def export_controller(
    source: str,
    /,
    *,
    out: Path = Path("estune_pidf.c"),
    c: Flag = False,
    board: Flag = False,
    start: Flag = False,
    schedule: Path | None = None,
    folder: Path | None = None,
) -> None:
    """Write a controller with its gains and settings as one C file for firmware.

    Args:
        source: A run, by its name or folder, or a rig's file such as my-rig.toml.
        out: The file to write.
        c: Write C, the only form there is.
        board: Write the program of a trial board beside it, with the limits of the rig's file.
        start: The gains the run began from, instead of the tuned ones.
        schedule: A gain schedule (JSON, as of a sweep) to be written beside it as a C header,
            estune_schedule.h.
        folder: Folder of runs; runs by default.
    """
    from estune.hardware import controller_source, read_config  # noqa: PLC0415  as above
    from estune.hardware.schedule_file import (  # noqa: PLC0415  as above
        read_schedule,
        schedule_header,
    )
    from estune.hardware.trial_board.export import (  # noqa: PLC0415  as above
        board_files,
        compensation_files,
    )
    from estune.support.whole_file import write_file  # noqa: PLC0415  as above

    if not c:
        raise InvalidInput("the form of the controller is missing; give --c")
    files: dict[Path, str] = {}
    if source.endswith(".toml"):
        config = read_config(source)
        settings, gains = config.settings(), config.describe().gains
        texts = board_files(config) if board else compensation_files(config)
        files = {out.with_name(name): text for name, text in texts.items()}
    elif board:
        raise InvalidInput("a board's program has the limits of a rig; give the rig's file")
    else:
        from estune import api  # noqa: PLC0415  slow to import
        from estune.cli.runs import find_run  # noqa: PLC0415  as above
        from estune.run.journal import RUNS  # noqa: PLC0415

        result = api.load(find_run(source, folder or Path(RUNS)))
        settings, gains = result.rig.controller, result.start_gains if start else result.gains
    files[out] = controller_source(settings, gains)
    if schedule is not None:
        files[out.with_name("estune_schedule.h")] = schedule_header(read_schedule(schedule))
    for path, text in files.items():
        write_file(path, text.encode())
        of = f"controller at {settings.sampling_Hz:g} Hz, {gains}: " if path == out else ""
        print(f"{of}{path}")
