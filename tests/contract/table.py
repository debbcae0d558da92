"""The contract as a page: what every public function promises, and which test holds it to that."""

from __future__ import annotations

from contract.cases import CASES, DOMAINS, OTHERS, Case
from contract.matrix import EVERY_CASE, combinations

_HEAD = """# What every public function promises

Written by `scripts/refresh_contract.py` from `tests/contract/cases.py`. Each case runs through all tests of
`tests/contract/test_contract.py`:

- **Types of results.** Arguments are numbers, lists, NumPy arrays or JAX arrays that broadcast. The results are
  NumPy scalars for numbers, NumPy arrays for NumPy arrays, and JAX arrays for JAX arrays, all in float64
  regardless of JAX's settings. Numbers are computed without loading JAX. Empty arrays return empty arrays. Values
  that are not real numbers, and shapes that do not broadcast, raise `InputError` with the name of the argument.
- **Types of arguments.** At most one argument is traced. The others are Python numbers, NumPy scalars, NumPy
  arrays of ints or floats, 0-d arrays, lists or JAX arrays. `tests/contract/test_matrix.py` tests
  {combinations:,} combinations of these types in direct calls and inside `jit`, `vmap`, `grad`, `jit(grad)` and
  the second derivative, in float64 and float32: every combination for one function per way of evaluation, and
  the common ones for all other functions. It includes methods of a rigid `Scene`.
- **Bad points.** For an entry that is NaN, infinite, or negative where negative values are not allowed, the
  result is that of the column "bad points", and the status, if there is one, is INVALID_INPUT. An entry outside
  the domain has the same result with the status OUT_OF_RANGE. Bad entries do not change the other entries. A
  number outside the domain raises `InputError` with field, value and range; "raises" in the column "bad number"
  means that NaN and negative numbers raise the error as well.
- **Inside `jit`, `vmap`, `grad` with x64.** Values and statuses agree with those of direct calls to 1e-11. Bad
  points behave as above.
- **Inside `jit` without x64.** float32 values agree to 2e-3 at moderate points, with the same statuses. Results
  outside the domain are NaN.
- **Derivatives** are finite at good points and NaN at bad ones. The contract tests cover the first order. The
  tests of each function cover the second order, and the first order of {elsewhere}.
- **On a graphics processor.** Inside `jit`, functions run on the device of JAX, with the same values and
  statuses; these tests pass on a graphics processor as well. Direct calls compute few points with NumPy, and
  divide many points into blocks that fit the caches of a CPU. On a graphics processor, call the functions inside
  your own `jit` instead.

Domains of finite arguments:

| domain | arguments |
|---|---|
{domains}
| function | domain | bad points | bad number | status | in jit | derivatives |
|---|---|---|---|---|---|---|
"""


def page() -> str:
    """The whole page."""
    rows = "".join(_row(case) for case in CASES)
    elsewhere = ", ".join(f"`{case.name}`" for case in CASES if case.gradient_in)
    domains = "".join(f"| {name} | {said} |\n" for name, said in DOMAINS.items())
    number = sum(1 for case in EVERY_CASE for _ in combinations(case))
    head = _HEAD.format(elsewhere=elsewhere, domains=domains, combinations=number)
    others = "".join(f"| `{name}` | {why} |\n" for name, why in sorted(OTHERS.items()))
    rest = "Functions that do not compute arrays point by point, and functions that compile even for numbers:"
    return f"{head}{rows}\n{rest}\n\n| function | arguments, and tests of the contract |\n|---|---|\n{others}"


def _row(case: Case) -> str:
    name = f"`{case.function}`{case.name.removeprefix(case.function)}"
    first = {key: values[0] for key, values in case.good.items()}
    status = "yes" if "status" in case.leaves(case.call(**first)) else "no"
    order = {None: "none", 1: "first", 2: "first, second"}[case.derivatives]
    concrete = f"yes, {', '.join(case.concrete)} concrete" if case.concrete else "yes"
    cells = (
        name,
        case.domain,
        case.value,
        "raises" if case.strict else "as in arrays",
        status,
        "refused" if case.refuses_tracing else concrete,
        order,
    )
    return f"| {' | '.join(cells)} |\n"
