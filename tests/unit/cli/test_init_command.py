"""`zwidth init`: every example is written and loadable, and no file is replaced."""

from pathlib import Path

import pytest
from click.testing import CliRunner

from zwidth.cli.commands import cli, find_examples
from zwidth.core.errors import InputError
from zwidth.studies.document import load_config

CONFIGS = Path(__file__).resolve().parents[3] / "configs"
EXAMPLES = sorted(file.stem for file in CONFIGS.glob("*.yaml"))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments):
    return CliRunner().invoke(cli, ["init", *arguments], catch_exceptions=False).output.splitlines()


def test_examples_are_the_shipped_configurations():
    assert list(find_examples()) == EXAMPLES != []
    assert all(path.read_bytes() == (CONFIGS / path.name).read_bytes() for path in find_examples().values())


@pytest.mark.parametrize("example", EXAMPLES)
def test_written_example_is_loadable_under_its_new_name(example, folder):
    assert run("mine", "--example", example)[-1].startswith("run it with: zwidth run mine.yaml ")
    written, original = load_config(folder / "mine.yaml"), load_config(CONFIGS / f"{example}.yaml")
    assert written == original.model_copy(update={"name": "mine"})
    # The schema's relative path is valid inside the project only.
    assert "$schema" not in (folder / "mine.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "arguments, file, example",
    [
        ((), "quickstart", "quickstart"),
        (("paper",), "paper", "paper"),
        (("mine.yaml",), "mine", "quickstart"),
        (("--example", "design"), "design", "design"),
        (("paper", "--example", "design"), "paper", "design"),
    ],
)
def test_name_and_example_default_to_each_other(arguments, file, example, folder):
    run(*arguments)
    assert [path.name for path in folder.iterdir()] == [f"{file}.yaml"]
    assert load_config(folder / f"{file}.yaml").studies == load_config(CONFIGS / f"{example}.yaml").studies


@pytest.mark.parametrize("name", ["devices.yaml", "devices.csv"])
def test_existing_files_are_not_replaced(name, folder):
    (folder / name).write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=rf"{name}: already exists.*another NAME"):
        run("devices")
    assert {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()} == {name: "mine"}


def test_existing_equal_table_is_reused(folder):
    assert run("devices")[:2] == ["wrote devices.yaml", "wrote devices.csv"]
    assert run("more", "--example", "devices")[0] == "wrote more.yaml"
    assert load_config(folder / "more.yaml").studies == load_config(folder / "devices.yaml").studies


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("--example", "quikstart"), "--example: got 'quikstart'.*did you mean 'quickstart'"),
        (("My device",), "NAME: got 'My device'; write 1 to 64"),
        (("../outside",), "NAME: got '../outside'"),
    ],
)
def test_invalid_names_raise(arguments, message, folder):
    with pytest.raises(InputError, match=message):
        run(*arguments)
    assert list(folder.iterdir()) == []


def test_two_names_are_refused_with_the_right_call(folder):
    result = CliRunner().invoke(cli, ["init", "amplifier", "mine"])
    assert result.exit_code != 0
    assert "zwidth init mine --example amplifier" in result.output + str(result.exception)
    assert list(folder.iterdir()) == []


def test_list_describes_each_example():
    lines = run("--list")
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == EXAMPLES
    assert lines[EXAMPLES.index("best_filter")] == "best_filter      Which filter is best?"
