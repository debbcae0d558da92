"""Command line `zwidth`: load all commands, run them, and convert exceptions to messages and exit codes.

Exit codes: 0 for a result, 1 for a failed computation, 2 for invalid input, 130 after Ctrl-C. Each error is one
message on stderr.
"""

from __future__ import annotations

import os
import re
import signal
import sys
from importlib import import_module
from pkgutil import iter_modules

import click

from zwidth.cli.commands import EXIT_FAILED, EXIT_INPUT, cli
from zwidth.core.errors import SYNONYMS, ZwidthError
from zwidth.io.files import REMEDIES
from zwidth.numerics.kernel_cache import use_compilation_cache

# Import every module of this package, because each module adds its commands to `cli` when it is imported.
for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)

# Exit codes after SIGINT and SIGTERM: 128 plus the signal number, as in a shell.
_STOPPED = (128 + signal.SIGINT, 128 + signal.SIGTERM)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line with the given arguments, by default those of the process, and exit with a code."""
    use_compilation_cache()
    try:
        # Disable colors if NO_COLOR is set or the terminal has none, because click ignores both. With None, click
        # decides whether to use colors.
        color = False if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" else None
        cli.main(args=arguments, prog_name="zwidth", standalone_mode=False, color=color)
    except SystemExit as end:
        if arguments is None and end.code in _STOPPED:
            # Skip the shutdown of the interpreter, because it would crash if JAX is compiling in another thread.
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(int(end.code))
        raise
    except click.exceptions.Abort:
        click.echo("zwidth: stopped", err=True)
        sys.exit(130)
    except click.ClickException as error:
        _report(_format_fault(error))
        sys.exit(error.exit_code)
    except ZwidthError as error:
        for line in str(error).splitlines():
            _report(line)
        sys.exit(EXIT_INPUT)
    except Exception as error:
        if os.environ.get("ZWIDTH_TRACEBACK"):
            raise
        _report(_describe(error))
        sys.exit(EXIT_FAILED)


def _report(message: str) -> None:
    """Print an error message on stderr."""
    click.echo(f"Error: {message}", err=True)


def _format_fault(error: click.ClickException) -> str:
    """Return the message for invalid arguments, which names the option, or the command that shows help."""
    if isinstance(error, click.NoSuchOption) and (option := _find_synonym(error)):
        message = f"No such option {error.option_name!r}; write {option}"
    else:
        message = error.format_message()
    if isinstance(error, click.BadParameter) and not isinstance(error, click.MissingParameter):
        return re.sub(r"^Invalid value for '?(.*?)'?: ", r"\1: ", message, count=1)
    context = getattr(error, "ctx", None)
    return f"{message.rstrip('.')}; see {context.command_path} --help" if context else message


def _find_synonym(error: click.NoSuchOption) -> str:
    """Return the option of the command whose name is a synonym of an unknown option, with an example; "" if none is."""
    words = error.option_name.lstrip("-").replace("dead-time", "dead_time").split("-")
    option = "--" + "-".join(SYNONYMS.get(word, word) for word in words)
    known = [flag for each in error.ctx.command.params for flag in each.opts] if error.ctx else []
    if option not in known or option == error.option_name:
        return ""
    return "--mass '1e-4 kg m^2'" if error.option_name == "--inertia" else option


def _describe(error: Exception) -> str:
    """Return the message of an exception; for an error of the operating system, it names file, reason and remedy."""
    if not isinstance(error, OSError):
        return f"{type(error).__name__}: {error} (set ZWIDTH_TRACEBACK=1 for the traceback)"
    reason = os.strerror(error.errno) if error.errno else str(error)
    fault = ": ".join(str(part) for part in (error.filename, reason) if part)
    return "; ".join(filter(None, (fault, REMEDIES.get(error.errno or 0))))
