"""Starting the command line as a process of its own, which outlives the one that starts it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path

from toolkit.files import disk_errors


def start_detached(arguments: Sequence[str], output: Path) -> None:
    """Start ``toolkit`` with these arguments; closing the browser or ending the server does not end it.

    Parameters
    ----------
    arguments:
        Of the command.
    output:
        File to which everything goes that it prints, after what is there.

    Raises
    ------
    RunError
        Where the disk refuses.
    """
    with disk_errors(output.parent, "writing"), output.open("ab") as printed:
        process = subprocess.Popen(
            [sys.executable, "-m", "toolkit", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=printed,
            stderr=printed,
            # UTF-8 also where Windows writes files in another code page.
            env={**os.environ, "TQDM_DISABLE": "1", "PYTHONUTF8": "1"},
            # A Ctrl-C that ends the server is not for it; the second says so on Windows, which knows no sessions.
            start_new_session=True,
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )
    # Somebody has to hear of its end, or it stays in the system's list as long as this process lives.
    threading.Thread(target=process.wait, name=f"end of {arguments[0]}", daemon=True).start()
