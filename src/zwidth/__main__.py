"""The command `zwidth`, and `python -m zwidth`."""

import gc
import os

# More objects than most commands load and make, of which hardly one is garbage.
_FIRST_COLLECTION = 1_000_000


def main() -> None:
    """Run the command line and exit."""
    # OpenBLAS reads this when NumPy is loaded. What is large runs on every processor by threads of our own; of small
    # matrices several threads of its own take longer than one, on a busy machine several times as long.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    put_off_collection()
    try:
        from zwidth.cli import main as run

        run()
    finally:
        # Python looks for garbage once more when it ends, as long as some commands take: nothing is left to look at.
        gc.freeze()


def put_off_collection() -> None:
    """Look for garbage late for the first time, and from then on as before: of a short command a tenth of its time."""
    usual = gc.get_threshold()

    def go_on_as_usual(*_: object) -> None:
        gc.callbacks.remove(go_on_as_usual)
        gc.set_threshold(*usual)

    gc.callbacks.append(go_on_as_usual)
    gc.set_threshold(_FIRST_COLLECTION)


if __name__ == "__main__":
    main()
