"""The contract as a page: what every public function promises, and which test holds it to that."""

from __future__ import annotations

from contract.cases import CASES, DOMAINS, OTHERS, Case
from contract.matrix import EVERY_CASE, combinations

_HEAD = """# What every public function promises

Written by `scripts/refresh_contract.py` from the cases of `tests/contract/cases.py`, each of which runs through all
tests of `tests/contract/test_contract.py`:

- **Anything in.** Numbers, lists, NumPy and JAX arrays that broadcast; numbers give NumPy scalars, NumPy arrays give
  NumPy arrays, JAX arrays give JAX arrays, all in float64 whatever JAX's settings. A number is answered without loading
  JAX. Nothing in, nothing out. What is no real number, and shapes that do not fit, raise `InputError` by name.
- **Every type of argument.** One argument traced or none, the others Python numbers, NumPy scalars and arrays of ints
  and floats, 0-d arrays, lists or JAX arrays; called directly and inside `jit`, `vmap`, `grad`, `jit(grad)` and the
  second derivative; in float64 and float32: {combinations:,} combinations, of methods of a rigid `Scene` as well
  (`tests/contract/test_matrix.py`).
- **Bad points.** An entry that is NaN, infinite or negative where it must not be gives what the column "bad points"
  says, with INVALID_INPUT where there is a status; one beyond the domain likewise, with OUT_OF_RANGE. Its neighbors
  keep every bit. A number beyond the domain raises `InputError` with field, value and range; "raises" in the column
  "bad number" says that NaN and negative numbers raise as well.
- **Inside `jit`, `vmap`, `grad` with x64.** Values and statuses are those of the direct call, to 1e-11; bad points and
  their neighbors behave as above.
- **Inside `jit` without x64.** float32 values to 2e-3 at moderate points, the same statuses; what lies beyond the
  domain is NaN there too.
- **Derivatives** are finite at good points and NaN at bad ones. The first order is tested here, the second in the tests
  of each function, and so is the first of {elsewhere}.
- **On a graphics processor.** Inside `jit` a function runs where JAX does, with these values and statuses: these tests
  pass on one, too. Called directly few points go to NumPy, and many to JAX in pieces made for a processor's caches: a
  million walls belong into your own `jit` there.

Domains, of arguments that are finite:

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
    rest = "Functions that take no arrays point by point, or that a number has compiled:"
    return f"{head}{rows}\n{rest}\n\n| function | takes, and where its promises are tested |\n|---|---|\n{others}"


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
