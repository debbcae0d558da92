"""Generator of docs/contract.md: what every public function guarantees, and which tests check it."""

from __future__ import annotations

from contract.cases import CASES, DOMAINS, OTHERS, SINGLE_ERROR, Case
from contract.matrix import EVERY_CASE, combinations

_HEAD = """# Contract of the public functions

This page describes how each public function treats its arguments, how it behaves inside the transformations of JAX,
and which derivatives it has. `scripts/refresh_contract.py` writes the page from `tests/contract/cases.py`, and
`tests/contract/test_contract.py` tests every statement for each function of the first table:

- **Types of results.** Arguments can be numbers, lists, NumPy arrays or JAX arrays, and are broadcast against each
  other. The results are NumPy scalars for numbers, NumPy arrays for lists and NumPy arrays, and JAX arrays for JAX
  arrays. All results have the type float64, regardless of the settings of JAX. Calls with numbers do not load JAX.
  Empty arrays return empty arrays. Values that are not real numbers, and shapes that cannot be broadcast, raise an
  `InputError` with the name of the argument.
- **Types of arguments.** `tests/contract/test_matrix.py` tests {combinations:,} combinations of types, in direct
  calls and inside `jit`, `vmap`, `grad`, `jit(grad)` and the second derivative, in float64 and float32. In each
  combination, at most one argument is traced. The other arguments are Python numbers, NumPy scalars, NumPy arrays of
  integers or floats, 0-d arrays, lists or JAX arrays. Functions that convert their arguments by the same code share
  one representative with all combinations; the other functions have the most common ones. The combinations also
  cover methods of a rigid `Scene`.
- **Bad points.** An entry of an array is bad if it is NaN or infinite, or if it is negative although negative values
  are not allowed. The column "bad points" contains the result for a bad entry. If the function returns a status, the
  status of this entry is INVALID_INPUT. An entry outside the domain has the same result, with the status
  OUT_OF_RANGE. Bad entries do not affect the results of other entries. A single number outside the domain raises an
  `InputError` with field, value and range. If the column "bad number" contains "raises", NaN and negative numbers
  raise this error as well.
- **Inside `jit`, `vmap` and `grad`, with x64 enabled.** Values and statuses agree with those of direct calls to 1e-11.
  Bad points have the results described above.
- **Inside `jit`, without x64.** At the valid points of the tests, float32 values agree with those of direct calls to
  {single:.1e}, relative and absolute, and the statuses are the same. Results outside the domain are NaN. The page [how
  to choose](how-to-choose.md#precision) lists the errors near and far from the stability boundary. For walls near
  the boundary, `tests/contract/test_float32.py` compares these errors with bounds.
- **Derivatives** are finite at good points and NaN at bad points. The tests of the contract cover the first
  derivatives. The tests of each function cover the second derivatives, and the first derivatives of {elsewhere}.
- **On devices of JAX.** Direct calls with JAX arrays are computed by compiled code on the devices of these arrays, and
  their results stay there, also if an array is distributed over several devices (`tests/contract/test_devices.py`).
  The method "certified" of `is_stable` and `decide_stability` computes on the host.

The domains of finite arguments are:

| domain | arguments |
|---|---|
{domains}
| function | domain | bad points | bad number | status | in jit | derivatives |
|---|---|---|---|---|---|---|
"""


def build_page() -> str:
    """Text of the page."""
    rows = "".join(_row(case) for case in CASES)
    elsewhere = ", ".join(f"`{case.name}`" for case in CASES if case.gradient_in)
    domains = "".join(f"| {name} | {description} |\n" for name, description in DOMAINS.items())
    number = sum(1 for case in EVERY_CASE for _ in combinations(case))
    head = _HEAD.format(elsewhere=elsewhere, domains=domains, combinations=number, single=SINGLE_ERROR)
    others = "".join(f"| `{name}` | {tests} |\n" for name, tests in sorted(OTHERS.items()))
    others_heading = (
        "The following functions are not covered by the tests above, because they do not compute their results\n"
        "elementwise, or because they compile JAX code even if all arguments are numbers. The second column contains\n"
        "the argument of each function, and the file that tests the function."
    )
    return f"{head}{rows}\n{others_heading}\n\n| function | argument, and file with its tests |\n|---|---|\n{others}"


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
