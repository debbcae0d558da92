"""`zwidth init`: every example is written, can be read where it stands, and replaces nothing."""

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


def test_the_examples_are_the_configurations_of_the_project():
    assert list(find_examples()) == EXAMPLES != []
    assert all(path.read_bytes() == (CONFIGS / path.name).read_bytes() for path in find_examples().values())


@pytest.mark.parametrize("example", EXAMPLES)
def test_what_is_written_runs_where_it_stands_under_its_own_name(example, folder):
    assert run("mine", "--example", example)[-1].startswith("run it with: zwidth run mine.yaml ")
    written, original = load_config(folder / "mine.yaml"), load_config(CONFIGS / f"{example}.yaml")
    assert written == original.model_copy(update={"name": "mine"})
    # The schema's path holds in the project alone.
    assert "$schema" not in (folder / "mine.yaml").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    "arguments, file, like",
    [
        ((), "quickstart", "quickstart"),
        (("paper",), "paper", "paper"),
        (("mine.yaml",), "mine", "quickstart"),
        (("--example", "design"), "design", "design"),
        (("paper", "--example", "design"), "paper", "design"),
    ],
)
def test_name_and_example_stand_in_for_each_other(arguments, file, like, folder):
    run(*arguments)
    assert [path.name for path in folder.iterdir()] == [f"{file}.yaml"]
    assert load_config(folder / f"{file}.yaml").studies == load_config(CONFIGS / f"{like}.yaml").studies


@pytest.mark.parametrize("name", ["devices.yaml", "devices.csv"])
def test_nothing_is_replaced_or_half_written(name, folder):
    (folder / name).write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match=rf"{name}: already exists.*another NAME"):
        run("devices")
    assert {path.name: path.read_text(encoding="utf-8") for path in folder.iterdir()} == {name: "mine"}


def test_a_table_that_is_there_already_serves_a_second_configuration(folder):
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
def test_wrong_names_are_refused(arguments, message, folder):
    with pytest.raises(InputError, match=message):
        run(*arguments)
    assert list(folder.iterdir()) == []


def test_the_list_says_what_each_example_is():
    lines = run("--list")
    assert [line.split()[0] for line in lines if not line.startswith(" ")] == EXAMPLES
    assert lines[EXAMPLES.index("best_filter")] == "best_filter      Which filter is best?"
