"""The command `zwidth`, and `python -m zwidth`."""

import os


def main() -> None:
    """Run the command line and exit."""
    # OpenBLAS reads this when NumPy is loaded. What is large runs on every processor by threads of our own; of small
    # matrices several threads of its own take longer than one, on a busy machine several times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from zwidth.cli import main as run

    run()


if __name__ == "__main__":
    main()
