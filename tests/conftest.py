"""Settings shared by all tests.

JAX keeps its default precision: the library's float64 must not depend on anyone's settings.
"""

import gc
import os
import signal
from pathlib import Path

# A shell that starts something in the background has it ignore Ctrl-C, and so would every program that tests start.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Set before anything imports matplotlib, and inherited by the programs that tests start.
os.environ["MPLBACKEND"] = "Agg"
# Commands print their lines whole.
os.environ.pop("COLUMNS", None)
# Processes test side by side: threads of one's small matrices would wait for a core that another has. Here a plugin of
# pytest has loaded NumPy already; the processes that pytest-xdist starts inherit this in time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most of the time would go into compiling: the processes that run tests share what one of them has compiled.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import pytest
from _pytest.doctest import DoctestModule
from hypothesis import HealthCheck, settings
from leftovers import what_is_open
from waiting import wait_for

settings.register_profile(
    "zwidth",
    # The same examples on every run: a failure is then a change in the code, not luck.
    derandomize=True,
    # The first example of a shape pays for its compilation.
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=60,
    print_blob=True,
)
settings.load_profile("zwidth")


def pytest_configure(config: pytest.Config) -> None:
    """What holds for a run as a whole."""
    # Most tests inside transformations keep JAX's default precision on purpose.
    config.addinivalue_line("filterwarnings", "ignore::zwidth.core.errors.PrecisionWarning")
    # Files begin in the order in which they are collected, the long ones of tests/contract and tests/e2e before those
    # of tests/unit: pytest-xdist would begin with those of the most tests, and a process would end with the longest.
    config.option.loadscopereorder = False
    # What is imported and collected stays: Python need not look for garbage in it again and again.
    gc.set_threshold(1_000_000)


def pytest_collection_modifyitems() -> None:
    """Silent broadcasting across ranks hides transposed axes; the process that only hands out tests needs no JAX."""
    import jax

    jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_finish() -> None:
    """Python looks for garbage less often: tracing makes so many objects that every sixth second went into it."""
    gc.collect()
    gc.set_threshold(50_000, 20, 20)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """What is there at the end is looked through once: pytest, and then Python, would do so again and again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(file_path: Path):
    """Examples are those of the package's docstrings: nobody reads tests for examples."""
    return [found for found in (yield) if not isinstance(found, DoctestModule)]


@pytest.fixture(scope="module", autouse=True)
def _nothing_is_left_open():
    """What the tests of a file open they close, lest those of another be blamed for it."""
    before = what_is_open()
    yield
    if what_is_open().beyond(before):
        gc.collect()
        wait_for(lambda: not what_is_open().beyond(before), lambda: f"still open: {what_is_open().beyond(before)}")


@pytest.fixture
def fitted_once():
    """Compute fits, wall searches and diagnoses that commands, studies and pages repeat only once."""
    from fitted_once import fitting_once

    with fitting_once():
        yield


@pytest.fixture
def early_compiler(monkeypatch):
    """Of some thousand points a compiler is asked, as a user's are who has many more."""
    from zwidth.numerics import evaluate
    from zwidth.stability.rigid import broadcasting, dominant_poles, passivity, stiffness_limit

    for module in (evaluate, broadcasting, dominant_poles, passivity, stiffness_limit):
        monkeypatch.setattr(module, "FEW", 1 << 11)


@pytest.fixture
def unpainted():
    """Pictures are not painted: what a test looks at is something else."""
    from unpainted import painting_nothing

    with painting_nothing():
        yield


@pytest.fixture
def x64():
    """Enable float64 in JAX for one test, as a user who traces the library's functions would."""
    import jax

    with jax.enable_x64(True):
        yield
