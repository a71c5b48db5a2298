"""Tab completion for bash, zsh and fish: `trirail completion`, and the names that a running service knows."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from trirail.cli import terminal
from trirail.errors import TrirailError

if TYPE_CHECKING:
    from cyclopts import App

Shell = Literal["bash", "zsh", "fish"]


def script(app: App, shell: Shell | None, *, install: bool) -> int:
    """Print the script for a shell, or install it for this user. If no shell is named, use the current one."""
    from cyclopts.completion.detect import ShellDetectionError

    try:
        made = app.install_completion(shell=shell) if install else app.generate_completion(shell=shell)
    except ShellDetectionError as error:
        raise TrirailError("shell not recognised: use bash, zsh or fish") from error
    except (OSError, RuntimeError) as error:  # a user without a home cannot be asked for a folder
        raise TrirailError(f"cannot install: {error}") from error
    if install:
        terminal.print_line(f"installed: {made}; new shells complete trirail")
    else:
        terminal.write(str(made))
    return 0
