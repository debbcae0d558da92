"""Settings and fixtures of all tests.

JAX keeps its default precision, because the library's float64 results must not depend on user settings.
"""

import gc
import os
import signal
from pathlib import Path

# Shells ignore Ctrl-C in background jobs, which programs started by tests would inherit.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Set before any import of matplotlib, and inherited by programs that tests start.
os.environ["MPLBACKEND"] = "Agg"
# Commands do not fold their lines.
os.environ.pop("COLUMNS", None)
# Test processes run in parallel: threads for small matrices would compete for cores. A plugin of pytest has already
# loaded NumPy in this process, but processes started by pytest-xdist inherit the setting in time.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Share compiled functions between test processes, because compilation would take most of the time.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parents[1] / ".cache" / "jax"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")

import pytest
from _pytest.doctest import DoctestModule
from hypothesis import HealthCheck, settings
from open_resources import list_open
from waiting import wait_for

settings.register_profile(
    "zwidth",
    # The same examples in every run, so that failures indicate changes of the code.
    derandomize=True,
    # The first example of a shape includes its compilation.
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    max_examples=60,
    print_blob=True,
)
settings.load_profile("zwidth")


def pytest_configure(config: pytest.Config) -> None:
    """Configure warnings, test order and garbage collection of the run."""
    # Most tests inside transformations use JAX's default precision intentionally.
    config.addinivalue_line("filterwarnings", "ignore::zwidth.core.errors.PrecisionWarning")
    # Distribute files in the order of collection, with the slow tests/contract and tests/e2e first. By default
    # pytest-xdist starts with the files of most tests, so that a slow file might run last.
    config.option.loadscopereorder = False
    # Imported and collected objects stay alive, so frequent garbage collection is useless.
    gc.set_threshold(1_000_000)


def pytest_collection_modifyitems() -> None:
    """Forbid implicit rank promotion, which hides transposed axes; the controlling process needs no JAX."""
    import jax

    jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_collection_finish() -> None:
    """Collect garbage less often, because tracing creates so many objects that it took a sixth of the time."""
    gc.collect()
    gc.set_threshold(50_000, 20, 20)


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """Collect garbage once at the end, and exclude the rest from the collections of pytest and Python at exit."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True)
def pytest_collect_file(file_path: Path):
    """Collect examples from the package's docstrings only, not from tests."""
    return [collector for collector in (yield) if not isinstance(collector, DoctestModule)]


@pytest.fixture(scope="module", autouse=True)
def _check_open_resources():
    """Check that each test file closes what it opens, so that leaks are attributed to the right file."""
    before = list_open()
    yield
    if list_open().list_new(before):
        gc.collect()
        wait_for(lambda: not list_open().list_new(before), lambda: f"still open: {list_open().list_new(before)}")


@pytest.fixture
def fitted_once():
    """Compute each fit, wall search and diagnosis of commands, studies and pages only once per process."""
    from fitted_once import fitting_once

    with fitting_once():
        yield


@pytest.fixture
def early_compiler(monkeypatch):
    """Use compiled kernels from 2048 points on, to test them with small batches."""
    from zwidth.numerics import evaluate
    from zwidth.stability.rigid import broadcasting, stiffness_limit
    from zwidth.stability.rigid.dominant import arrays

    for module in (evaluate, broadcasting, arrays, stiffness_limit):
        monkeypatch.setattr(module, "FEW", 1 << 11)


@pytest.fixture
def unpainted():
    """Draw figures without rendering them, for tests of other things."""
    from unpainted import painting_nothing

    with painting_nothing():
        yield


@pytest.fixture
def x64():
    """Enable float64 in JAX for one test, as a user who traces the library's functions would."""
    import jax

    with jax.enable_x64(True):
        yield
