"""Command line and main loop of the benchmarks that count correct results for random devices."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

PRINTED = 10  # number of devices after which the totals are printed


def build_parser(doc: str | None, devices: int) -> argparse.ArgumentParser:
    """Return a parser of the options for the number of devices, with this default, and for the first seed."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", type=int, default=devices)
    parser.add_argument("--first", type=int, default=0, help="seed of the first device")
    return parser


def count_devices(given: argparse.Namespace, check: Callable[[int], tuple[Counter[str], list[str]]]) -> None:
    """Print failures and totals for all devices; ``check`` returns the counts and the failures for one seed."""
    total: Counter[str] = Counter()
    for seed in range(given.first, given.first + given.devices):
        counts, failures = check(seed)
        for failure in failures:
            print(f"seed {seed}: {failure}", flush=True)
        total.update(counts)
        if (seed + 1) % PRINTED == 0:
            print("; ".join(f"{name} {count}" for name, count in total.items()), flush=True)
    print("".join(f"\n{name:<32}{count}" for name, count in total.items()))
