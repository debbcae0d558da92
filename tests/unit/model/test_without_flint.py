"""Test linear devices without python-flint: the results equal those with python-flint.

Reference: the closed form of masses without damping.
"""

import json
import subprocess
import sys

import numpy as np
import pytest

import zwidth
from zwidth.model.exact_polynomials import find_common_factor, find_roots, multiply, trim

PROGRAM = """
import sys
sys.modules["flint"] = None  # an import raises ImportError, as where it is not installed
import json
import control, numpy as np, scipy.signal
import zwidth
systems = [
    scipy.signal.TransferFunction([1.0], [0.1, 10.0, 0.0]),
    ([1.0, 20.0], [0.1, 10.0, 5e3, 0.0]),
    ([1.0], [0.1, 0.0, 0.0]),
    "1 0 / 1 2 1",
    scipy.signal.ZerosPolesGain([-300.0], [0.0, -40.0, -100 + 700j, -100 - 700j], 1e6),
    (np.array([[0.0, 1.0], [-900.0, -3.0]]), np.array([[0.0], [4.0]]), np.array([[1.0, 0.0]])),
    scipy.signal.TransferFunction([1e-5, 0.0], [1.0, -1.9, 0.9], dt=1e-3),
    scipy.signal.StateSpace([[0.0, 1.0], [-900.0, -3.0]], [[0.0], [4.0]], [[1.0, 0.0]], [[0.0]]),
    control.tf([1.0], [0.1, 10.0, 0.0]) + control.tf([1.0], [1.0, 200.0, 0.0]),
    control.ss([[0.0, 1.0], [0.0, -100.0]], [[0.0], [10.0]], [[1.0, 0.0]], [[0.0]]),
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


def test_results_without_flint_equal_results_with_flint():
    without_flint = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, check=False)
    assert without_flint.returncode == 0, without_flint.stderr
    pytest.importorskip("flint")
    program = PROGRAM.replace('sys.modules["flint"] = None', "pass")
    with_flint = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    np.testing.assert_allclose(json.loads(without_flint.stdout), json.loads(with_flint.stdout), rtol=1e-13)
    # m = 0.1 kg, b = 10 N s/m and a delay of one period.
    assert json.loads(without_flint.stdout)[2][0] == pytest.approx(19864.93, rel=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.3e-3, 1.5e-3])
def test_undamped_mass_as_linear_device_matches_closed_form(delay):
    """In 1/(m s^2), a chain of integrators, no coefficient of the denominator sets a time scale."""
    mass = zwidth.Scene(zwidth.Device(0.1), zwidth.Timing(1e-3, delay)).max_stiffness()
    system = zwidth.Scene(zwidth.LinearDevice("10 / 1 0 0"), zwidth.Timing(1e-3, delay)).max_stiffness()
    assert system.stiffness == pytest.approx(mass.stiffness, rel=1e-12)
    assert system.virtual_damping == pytest.approx(mass.virtual_damping, rel=1e-6)


def test_roots_of_exact_polynomials():
    """A triple root, a root at 0 and a conjugate pair on the imaginary axis, without rounding errors."""
    factors = [trim([1, 3]), trim([1, 3]), trim([1, 3]), trim([1, 0]), trim([1, 0, 49]), trim([1, -1e-9])]
    product = trim([2])
    for factor in factors:
        product = multiply(product, factor)
    roots = sorted(find_roots(product).tolist(), key=lambda root: (root.real, root.imag))
    assert roots == [-3, -3, -3, -7j, 0, 7j, 1e-9]
    assert sorted(find_roots(trim([1, -1.5, 0.5]), offsets=True).tolist(), key=abs) == [0, 0.5]
    assert find_common_factor(product, multiply(trim([5, 15]), trim([1, 2]))) == trim([1, 3])
