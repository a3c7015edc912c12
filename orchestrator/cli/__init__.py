"""The ``muster`` command: one module per group of commands. Errors end as one line and an exit code.

Exit codes: 0 done, 1 failure, 2 wrong use.
"""

from __future__ import annotations

import signal
import sys

import typer

from orchestrator.cli.misuse import Misuse, describe
from orchestrator.cli.terminal import echo, log_visibly, one_line
from orchestrator.domain.errors import ApiError, NoUrl, ServerError, SpecError, Unreachable, UsageError
from shared_store import __version__
from shared_store.contract.plugins import PluginError, plugins
from shared_store.volume.layout import StoreError

try:
    from orchestrator.cli.catalogue import ENTRIES, Catalogue, ServerOption, add_placeholders
except PluginError as error:  # before any command exists
    sys.exit(f"muster: {one_line(str(error))}")

app = typer.Typer(
    name="muster",
    cls=Catalogue,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Runs one robot-learning job on many machines as if they were one.",
    epilog="Start with:  muster run job_specs/cartpole.yaml\nComplete commands with the Tab key:  muster --install-completion",
)
add_placeholders(app)

_NO_ROUTE = (
    "the controller lacks this plug-in: install its package where the controller runs, and restart the controller"
)


def _version(shows: bool) -> None:
    if shows:
        echo(f"muster {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    server: ServerOption = None,
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    pass


def main() -> None:
    """Entry point of the command."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # where it is ignored, the exit codes of processes are lost
    log_visibly()
    try:
        sys.exit(app(prog_name="muster", standalone_mode=False) or 0)
    except Misuse as error:
        if words := describe(error, [entry.name for entry in ENTRIES]):
            echo(f"muster: {one_line(words)}", err=True)
        sys.exit(2)
    except typer.Abort:
        echo("muster: nothing was done", err=True)
        sys.exit(1)
    except (SpecError, UsageError, NoUrl) as error:
        _fail(error, 2)
    except ApiError as error:
        of_plugins = {command.name for plugin in plugins().values() for command in plugin.commands}
        if error.status == 404 and str(error).endswith(": Not Found") and of_plugins.intersection(sys.argv[1:]):
            error = ApiError(f"{error}; {_NO_ROUTE}", 404)
        _fail(error, 2 if error.status in (400, 404) else 1)
    except (Unreachable, ServerError, StoreError, PluginError) as error:
        _fail(error, 1)
    except KeyboardInterrupt:
        sys.exit(130)


def _fail(error: Exception, code: int) -> None:
    echo(f"muster: {one_line(str(error))}", err=True)
    sys.exit(code)
