"""Entry point of the command `zwidth` and of `python -m zwidth`."""

import atexit
import gc
import os


def main() -> None:
    """Run the command line and exit."""
    # Limit OpenBLAS to one thread, because the matrices of zwidth are small: on a busy machine several OpenBLAS threads
    # take several times as long as one. For large arrays zwidth starts its own threads. OpenBLAS reads this variable
    # when NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Skip the garbage collection at exit, because it takes 10 % of the time of a short command.
    atexit.register(gc.freeze)
    from zwidth.cli import main as run

    run()


if __name__ == "__main__":
    main()
