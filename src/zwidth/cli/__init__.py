"""The command line.

Exit code 0: done; 1: the work failed; 2: the input was wrong. Errors go to stderr, one message a fault.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import click

from zwidth.cli.commands import cli
from zwidth.errors import ZwidthError

_EXIT_FAILED, _EXIT_INPUT = 1, 2


def _use_compilation_cache() -> None:
    """Let JAX keep compiled kernels in the user's cache folder, unless JAX was told otherwise."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(base / "zwidth" / "jax")
    # Every kernel is worth keeping: the many small ones add up to most of a cold start.
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit."""
    _use_compilation_cache()
    try:
        cli.main(args=arguments, prog_name="zwidth", standalone_mode=False)
    except click.exceptions.Abort:
        click.echo("zwidth: stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except ZwidthError as error:
        for line in str(error).splitlines():
            click.echo(f"zwidth: {line}", err=True)
        sys.exit(_EXIT_INPUT)
    except BrokenPipeError:
        # The reader of a pipe, `head` say, has gone: nothing is wrong.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)
    except Exception as error:
        if os.environ.get("ZWIDTH_TRACEBACK"):
            raise
        click.echo(f"zwidth: {type(error).__name__}: {error} (set ZWIDTH_TRACEBACK=1 for the traceback)", err=True)
        sys.exit(_EXIT_FAILED)
