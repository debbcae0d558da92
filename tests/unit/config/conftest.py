import pytest

from zwidth.studies import load_config


@pytest.fixture
def load(tmp_path):
    def from_text(text):
        path = tmp_path / "config.yaml"
        path.write_text(f"version: 1\nname: test\n{text}", encoding="utf-8")
        return load_config(path)

    return from_text
