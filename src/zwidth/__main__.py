"""The command `zwidth`, and `python -m zwidth`."""

import atexit
import gc
import os


def main() -> None:
    """Run the command line and exit."""
    # OpenBLAS reads this when NumPy is loaded. Large work runs on every processor in threads of zwidth; for small
    # matrices several OpenBLAS threads are slower than one, several times on a busy machine.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Skip the collection at exit, a tenth of the time of a short command: the process ends anyway.
    atexit.register(gc.freeze)
    from zwidth.cli import main as run

    run()


if __name__ == "__main__":
    main()
