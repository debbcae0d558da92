"""Test that files are written completely or not at all, and that errors name the file given by the caller."""

import errno
import os
import stat

import pytest

from zwidth.io.files import temporary_sibling, write_atomically


def test_write_to_a_named_pipe_keeps_the_pipe(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDWR)
    try:
        write_atomically(pipe, b"all of it")
        assert os.read(end, 100) == b"all of it"
    finally:
        os.close(end)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.parametrize("has_name", [True, False])
def test_full_disk_keeps_the_old_file_and_error_names_the_target(tmp_path, has_name):
    file = tmp_path / "a.csv"
    file.write_bytes(b"before")

    def fill():
        with temporary_sibling(file) as partial:
            partial.write_bytes(b"ha")
            # The operating system names the file in errors on opening, but not in errors on writing.
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *((str(partial),) if has_name else ()))

    with pytest.raises(OSError, match="No space left on device") as error:
        fill()
    assert error.value.filename == str(file)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
    assert file.read_bytes() == b"before"
