"""Files are whole or absent, whatever stops their writing, and the error names them as the caller does."""

import errno
import os
import stat

import pytest

from zwidth.io.files import temporary_sibling, write_atomically


def test_a_pipe_is_written_and_stays_a_pipe(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    end = os.open(pipe, os.O_RDWR)
    try:
        write_atomically(pipe, b"all of it")
        assert os.read(end, 100) == b"all of it"
    finally:
        os.close(end)
    assert stat.S_ISFIFO(pipe.stat().st_mode)


@pytest.mark.parametrize("named", [True, False])
def test_a_full_disk_leaves_the_old_file_and_is_told_of_the_file_by_its_name(tmp_path, named):
    file = tmp_path / "a.csv"
    file.write_bytes(b"before")

    def fill():
        with temporary_sibling(file) as partial:
            partial.write_bytes(b"ha")
            # The system names the file where it is opened, and nothing where it is written.
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *((str(partial),) if named else ()))

    with pytest.raises(OSError, match="No space left on device") as caught:
        fill()
    assert caught.value.filename == str(file)
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]
    assert file.read_bytes() == b"before"
