"""`estune explain-page`: a diagnosis in the browser."""

import threading
from datetime import datetime
from pathlib import Path

from estune.cli.values import OptionalText

PORT = 8766


def explain_page(
    data: Path | None = None,
    /,
    *,
    model: OptionalText = "",
    folder: Path | None = None,
    port: int | None = None,
) -> None:
    """Explain records in the browser: columns, model, verdict.

    The page takes files that are dropped on it, or a folder of this machine; shows how they are
    understood; and runs estune explain. It listens on 127.0.0.1, needs the key in the printed
    address, and sends nothing elsewhere.

    Args:
        data: Folder of records, or a file; the page can open others.
        model: The model, as of estune explain; the page has a form for others.
        folder: Folder for dropped files, the model and the results; explained/TIME by default.
        port: Port of the page; by default 8766, or a free one where that is taken.

    Raises:
        InvalidInput: the port is taken, or the records or the model cannot be used.
    """
    from estune.web.http_service import usual_port  # noqa: PLC0415  slow to import
    from plants.explain_page.server import ExplainPage  # noqa: PLC0415  as above
    from plants.explain_page.workbook import Workbook  # noqa: PLC0415  as above

    made = folder or Path("explained") / f"{datetime.now().astimezone():%Y%m%d-%H%M%S}"
    workbook = Workbook(made)
    if data is not None:
        workbook.use(str(data))
    if model:
        workbook.use_model(reference=model)
    page = ExplainPage(workbook, usual_port(PORT) if port is None else port)
    print(f"page at {page.address}", flush=True)
    try:
        threading.Event().wait()
    finally:
        page.close()
