"""Linear devices in a core install: python-flint is not there, and every number is the same."""

import json
import subprocess
import sys

import numpy as np
import pytest

import zwidth
from zwidth.loops.linear.certified import prove_zeros
from zwidth.loops.linear.sampled_zeros import find_sampled_zeros
from zwidth.parts.exact_polynomials import find_common_factor, find_roots, multiply, trim

PROGRAM = """
import sys
sys.modules["flint"] = None  # an import raises ImportError, as where it is not installed
import json
import numpy as np, scipy.signal
import zwidth
systems = [
    scipy.signal.TransferFunction([1.0], [0.1, 10.0, 0.0]),
    ([1.0, 20.0], [0.1, 10.0, 5e3, 0.0]),
    "1 0 / 1 2 1",
    scipy.signal.ZerosPolesGain([-300.0], [0.0, -40.0, -100 + 700j, -100 - 700j], 1e6),
    (np.array([[0.0, 1.0], [-900.0, -3.0]]), np.array([[0.0], [4.0]]), np.array([[1.0, 0.0]])),
    scipy.signal.TransferFunction([1e-5, 0.0], [1.0, -1.9, 0.9], dt=1e-3),
]
found = []
for system in systems:
    device = zwidth.LinearDevice(system)
    for delay in (0.0, 1e-3) if device.dt else (0.0, 0.4e-3, 1e-3):
        scene = zwidth.Scene(device, zwidth.Timing(1e-3, delay))
        wall = scene.max_stiffness()
        found.append([float(wall.stiffness), float(wall.virtual_damping), int(wall.status)])
print(json.dumps(found))
"""


def test_a_core_install_finds_the_same_walls():
    blocked = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert blocked.returncode == 0, blocked.stderr
    pytest.importorskip("flint")
    program = PROGRAM.replace('sys.modules["flint"] = None', "pass")
    with_flint = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    np.testing.assert_allclose(json.loads(blocked.stdout), json.loads(with_flint.stdout), rtol=1e-13)
    # m = 0.1 kg, b = 10 N s/m and a period of delay.
    assert json.loads(blocked.stdout)[2][0] == pytest.approx(19864.93, rel=1e-6)


@pytest.mark.parametrize("fraction", [0.0, 0.3, 1e-3])
def test_zeros_between_samples_are_those_of_ball_arithmetic(fraction):
    pytest.importorskip("flint")
    rng = np.random.default_rng(5)
    for count in (1, 2, 4, 5):
        poles = -(10 ** rng.uniform(0, 4, count)) + 0j
        poles = np.concatenate([poles, [-30 + 800j, -30 - 800j]])
        zeros = -(10 ** rng.uniform(0, 4, count - 1))
        device = zwidth.LinearDevice((zeros, poles, 3.0))
        gain, offsets = prove_zeros(device, 1e-3, (fraction, 0))
        lead, found = find_sampled_zeros(device, 1e-3, fraction)
        assert lead * device.mass / 1e-6 == pytest.approx(gain, rel=1e-14)
        order = [np.lexsort((np.imag(part), np.real(part))) for part in (offsets, found)]
        np.testing.assert_allclose(found[order[1]], offsets[order[0]], rtol=1e-14)


def test_roots_of_exact_polynomials():
    """A triple root, a root at 0 and a conjugate pair on the imaginary axis, without rounding."""
    factors = [trim([1, 3]), trim([1, 3]), trim([1, 3]), trim([1, 0]), trim([1, 0, 49]), trim([1, -1e-9])]
    product = trim([2])
    for factor in factors:
        product = multiply(product, factor)
    found = sorted(find_roots(product).tolist(), key=lambda root: (root.real, root.imag))
    assert found == [-3, -3, -3, -7j, 0, 7j, 1e-9]
    assert sorted(find_roots(trim([1, -1.5, 0.5]), offsets=True).tolist(), key=abs) == [0, 0.5]
    assert find_common_factor(product, multiply(trim([5, 15]), trim([1, 2]))) == trim([1, 3])
