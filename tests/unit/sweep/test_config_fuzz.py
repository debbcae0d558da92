"""Whatever the bytes, reading ends soon, with a configuration or with a ConfigError."""

import random
import time
from pathlib import Path

import pytest

from zwidth.errors import ConfigError
from zwidth.sweep.config import Config, load_config

CONFIGS = Path(__file__).parents[3] / "configs"
SEEDS = range(300)
# Far above what reading takes (some 50 ms), far below what a quadratic reader would take.
LONGEST_SECONDS = 5.0

# Bits of YAML that change how the rest is read, and values at the edge of what the fields allow.
SCRAPS = [
    *"[]{}:,-?&*!|>'\"%@`#\t\n\r\0\\",
    *("- ", ": ", "\n---\n", "\n...\n", "&a ", "*a", "<<: ", "!!float ", "!<", "%YAML 1.", "? ", "|\n", ">-9\n"),
    *("null", "~", "true", ".nan", "-.inf", "1e999", "-1", "0x", "9" * 400, "1e-999", '"\\ud800"', '"\\U00110000"'),
    *("1 periods", "1 kN/m", "kind: map", "delay_model: fractional_power", "{linear: {start: 0, stop: 1, num: 99999}}"),
]


def mutated(data, rng):
    """The file with one to eight changes."""
    data = bytearray(data)
    for _ in range(rng.randint(1, 8)):
        start = rng.randrange(len(data) + 1)
        stop = min(len(data), start + rng.choice([0, 1, 2, 8, 40]))
        match rng.randrange(6):
            case 0:
                data[start:stop] = b""
            case 1:
                data[start:stop] = bytes(rng.randrange(256) for _ in range(rng.randint(1, 4)))
            case 2:
                data[start:stop] = rng.choice(SCRAPS).encode("utf-8", "surrogatepass")
            case 3:
                data[start:start] = data[start : start + rng.choice([1, 10, 200, 2000])] * rng.randint(1, 3)
            case 4:
                data[start:start] = rng.choice(SCRAPS).encode() * rng.choice([2, 50, 1000])
            case _:
                lines = data.split(b"\n")
                rng.shuffle(lines)
                data[:] = b"\n".join(lines)
    return bytes(data)


@pytest.mark.parametrize("seed", SEEDS)
def test_any_bytes_end_in_a_config_or_a_clear_error(seed, tmp_path):
    rng = random.Random(seed)
    path = tmp_path / "fuzzed.yaml"
    path.write_bytes(mutated(rng.choice(sorted(CONFIGS.glob("*.yaml"))).read_bytes(), rng))
    start = time.perf_counter()
    try:
        assert isinstance(load_config(path), Config)
    except ConfigError as error:
        for line, fault in zip(str(error).split("\n"), error.faults, strict=True):
            assert line == str(fault)
            assert line.isprintable()
            assert fault.remedy
    assert time.perf_counter() - start < LONGEST_SECONDS
