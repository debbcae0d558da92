"""Every public name is documented, in one order of sections, with an example that runs as a doctest."""

import doctest
import inspect
import re
import tomllib
from pathlib import Path

import zwidth

ROOT = Path(__file__).resolve().parents[2]
ORDER = ["Args", "Attributes", "Returns", "Raises", "Numerics", "References", "Example"]
FUNCTIONS = sorted(name for name in zwidth.__all__ if inspect.isfunction(getattr(zwidth, name)))
CLASSES = sorted(name for name in zwidth.__all__ if inspect.isclass(getattr(zwidth, name)))
# What handles files holds no formula that somebody published.
WITHOUT_REFERENCES = {"limits_of", "load_config", "load_scene", "open_dataset", "run", "use_compilation_cache"}


def each(names):
    """One test of many names, which says where it failed."""

    def decorate(check):
        def test():
            for name in names:
                try:
                    check(name)
                except AssertionError as error:
                    raise AssertionError(f"{name}: {error}") from error

        test.__name__ = check.__name__
        return test

    return decorate


def sections(text):
    """Section name -> its lines, in the order of the docstring."""
    found, name = {}, "summary"
    for line in inspect.cleandoc(text).splitlines():
        heading = re.fullmatch(rf"({'|'.join(ORDER)}):", line)
        if heading:
            name = heading.group(1)
            assert name not in found, f"{name} twice"
        found.setdefault(name, []).append(line)
    return found


@each(zwidth.__all__)
def test_every_public_name_says_what_it_is(name):
    if name == "__version__":
        return
    text = getattr(zwidth, name).__doc__
    assert text
    # What NamedTuple, dataclass and IntEnum write by themselves says nothing.
    assert not re.match(rf"{name}\(|An enumeration|int\(", text)
    assert re.fullmatch(r"[A-Z`].*[.:]", text.splitlines()[0]), "the first line is one sentence"


@each(FUNCTIONS)
def test_functions_have_their_sections_in_order(name):
    function = getattr(zwidth, name)
    found = sections(function.__doc__)
    present = [section for section in found if section != "summary"]
    assert present == sorted(present, key=ORDER.index)
    needed = {"Args", "Returns", "Example"} | (set() if name in WITHOUT_REFERENCES else {"References"})
    assert needed <= set(present)


@each(FUNCTIONS)
def test_functions_describe_every_parameter(name):
    function = getattr(zwidth, name)
    described = set(re.findall(r"^    (\w+(?:, \w+)*):", "\n".join(sections(function.__doc__)["Args"]), re.MULTILINE))
    described = {single for group in described for single in group.split(", ")}
    assert described == set(inspect.signature(function).parameters)


@each(FUNCTIONS)
def test_references_name_author_and_year(name):
    for line in sections(getattr(zwidth, name).__doc__).get("References", [])[1:]:
        if line.strip() and not line.startswith(" " * 8):
            assert re.search(r"\b(18|19|20)\d\d\b|method|D-decomposition", line), line


@each(FUNCTIONS)
def test_examples_are_short_and_run(name):
    examples = doctest.DocTestParser().get_examples(getattr(zwidth, name).__doc__)
    assert examples
    lines = sum(example.source.count("\n") + example.want.count("\n") for example in examples)
    assert lines < 10
    assert any(example.want for example in examples)


@each(CLASSES)
def test_classes_keep_the_order_too(name):
    present = [section for section in sections(getattr(zwidth, name).__doc__) if section != "summary"]
    assert present == sorted(present, key=ORDER.index)


def test_doctests_are_part_of_the_test_run():
    options = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["pytest"]["ini_options"]
    assert "src" in options["testpaths"]
    assert "--doctest-modules" in options["addopts"]


def test_theorems_are_cited_by_their_names():
    """A citation of docs/theory in the code names a theorem or lemma that stands on that page."""
    cited = 0
    for path in sorted((ROOT / "src").rglob("*.py")):
        text = re.sub(r"\s+", " ", path.read_text(encoding="utf-8"))
        for page, kind, names in re.findall(r"docs/theory/([\w-]+\.md), (Theorem|Lemma)s? (\w+(?: and \w+)?)", text):
            known = (ROOT / "docs" / "theory" / page).read_text(encoding="utf-8")
            for name in names.split(" and "):
                cited += 1
                assert re.search(rf"^#+ {kind} {name}:", known, re.MULTILINE), (path.name, page, kind, name)
    assert cited >= 6
