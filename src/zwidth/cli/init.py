"""`zwidth init`: an example configuration to begin with."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path

import click

from zwidth.cli.commands import cli
from zwidth.words.errors import InputError, ZwidthError, check_choice

_PACKAGE = Path(__file__).resolve().parents[1]
# A table that a configuration reads from its own folder.
_TABLE = re.compile(r"csv: *([\w.-]+\.csv)")


def _complete(context: click.Context, parameter: click.Parameter, begun: str) -> list[str]:
    return [name for name in find_examples() if name.startswith(begun)]


@cli.command()
@click.argument("name", required=False, shell_complete=_complete)
@click.option(
    "--example",
    metavar="EXAMPLE",
    shell_complete=_complete,
    help="The example to begin with.  [default: NAME's, else quickstart]",
)
@click.option("--list", "listing", is_flag=True, help="List the examples.")
def init(name: str | None, example: str | None, listing: bool) -> None:
    """Write an example configuration NAME.yaml, to run and to change.

    No file is ever replaced. Without a NAME the file is named after the example.
    """
    known = find_examples()
    if listing:
        width = max(map(len, known))
        for each, path in known.items():
            words = textwrap.wrap(describe_example(path.read_text(encoding="utf-8")), 96 - width)
            click.echo(f"{each:<{width}}  " + f"\n{'':<{width}}  ".join(words))
        return
    example = example or (name if name in known else "quickstart")
    check_choice("--example", example, tuple(known))
    name = (name or example).removesuffix(".yaml")
    if not re.fullmatch("[a-z0-9_-]{1,64}", name):
        raise InputError(f"NAME: got {name!r}; write 1 to 64 of a-z, 0-9, _ and -, as in my_device")
    text = known[example].read_text(encoding="utf-8")
    # The schema's place is known in a checkout alone, and each configuration has results of its own.
    text = re.sub(r"\A# yaml-language-server:.*\n(?:#\n)?", "", text)
    text = re.sub(r"(?m)^name: .*$", f"name: {name}", text, count=1)
    files = {Path(f"{name}.yaml"): text}
    files |= {
        Path(table): known[example].with_name(table).read_text(encoding="utf-8") for table in _TABLE.findall(text)
    }
    # A table that is there as it would be written serves as it is.
    wanted = {file: text for file, text in files.items() if file.suffix == ".yaml" or not _holds(file, text)}
    for file in wanted:
        if file.exists() or file.is_symlink():
            raise InputError(f"{file}: is there already and stays as it is; give another NAME, or move it away")
    for file, content in wanted.items():
        with open(file, "x", encoding="utf-8") as stream:
            stream.write(content)
        click.echo(f"wrote {file}")
    click.echo(f"run it with: zwidth run {name}.yaml   (results go to runs/{name})")


def _holds(file: Path, text: str) -> bool:
    return file.is_file() and file.read_bytes() == text.encode("utf-8")


def find_examples() -> dict[str, Path]:
    """The example configurations by name: those of the package, or of the checkout that it is imported from."""
    packaged = _PACKAGE / "examples"
    folder = packaged if packaged.is_dir() else _PACKAGE.parents[1] / "configs"
    found = {file.stem: file for file in sorted(folder.glob("*.yaml"))}
    if not found:
        raise ZwidthError(f"init: {packaged} holds no examples; install zwidth again")
    return found


def describe_example(text: str) -> str:
    """The first sentence of a configuration's comments."""
    comments = [line.lstrip("# ") for line in text.splitlines() if line.startswith("#")][1:]
    sentence = re.match(r".*?[.?](?= |$)", " ".join(line for line in comments if line))
    assert sentence is not None, "every example says what it is"
    return sentence.group()
