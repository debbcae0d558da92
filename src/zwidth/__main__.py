"""The command `zwidth`, and `python -m zwidth`."""

import atexit
import gc
import os


def main() -> None:
    """Run the command line and exit."""
    # OpenBLAS reads this variable when NumPy is loaded. Its matrices here are small: on a busy machine several OpenBLAS
    # threads take several times as long as one. zwidth starts its own threads for large arrays.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Skip the garbage collection at exit, because it takes a tenth of the time of a short command.
    atexit.register(gc.freeze)
    from zwidth.cli import main as run

    run()


if __name__ == "__main__":
    main()
