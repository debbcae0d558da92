"""Test measured devices: validation of the frequency response, and files in the units and formats of analyzers."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import scipy.io

import zwidth
from zwidth.core.errors import InputError
from zwidth.identification.columns import read_log

F = np.geomspace(2.0, 400.0, 40)
G = 1.0 / (-0.1 * (2 * np.pi * F) ** 2 + 2j * np.pi * F)


def device(frequency: Any = F, response: Any = G, deviation: Any = None) -> zwidth.MeasuredDevice:
    return zwidth.MeasuredDevice(frequency, response, deviation)


REFUSED = {
    "decreasing frequencies": (lambda: device(F[::-1]), "frequency", "sort"),
    "repeated frequencies": (lambda: device(np.repeat(F[:20], 2)), "frequency", "remove duplicates"),
    "zero frequency": (lambda: device(F - F[0]), "frequency", "> 0"),
    "few frequencies": (lambda: device(F[:5], G[:5]), "frequency", "at least 8"),
    "unequal lengths": (lambda: device(F[1:]), "response", "one value per frequency"),
    "NaN": (lambda: device(response=np.where(F > 300, np.nan, G)), "response", "not finite"),
    "text": (lambda: device(response=["fast"] * 40), "response", "list of complex"),
    "complex frequency": (lambda: device(F + 0j), "frequency", "list of float"),
    "matrix": (lambda: device(response=G[:, None]), "response", "list of numbers"),
    "negative deviation": (lambda: device(deviation=-1e-9), "deviation", ">= 0"),
    "zero response": (lambda: device(response=0 * G), "response", "column of the position"),
}


@pytest.mark.parametrize("make, field, remedy", REFUSED.values(), ids=REFUSED)
def test_invalid_responses_are_rejected(make, field, remedy):
    with pytest.raises(InputError, match=rf"^{field}: .*{remedy}"):
        make()


def test_measured_device_is_an_immutable_value():
    assert device(deviation=1e-9) == device(deviation=np.full(40, 1e-9))
    assert device() != device(deviation=1e-9)
    assert hash(device()) == hash(device())
    assert repr(device(deviation=1e-9)) == "MeasuredDevice(40 lines from 2 to 400 Hz, with deviation)"
    assert device().mass == pytest.approx(0.1, rel=0.01)
    with pytest.raises(ValueError, match="read-only"):
        device().response[0] = 1.0


def test_saved_table_is_read_back_exactly(tmp_path):
    first = device(deviation=np.abs(G) * 0.01)
    first.save(tmp_path / "response.csv", "measured on Monday")
    assert zwidth.MeasuredDevice.read(tmp_path / "response.csv") == first
    assert (tmp_path / "response.csv").read_text().startswith("# measured on Monday\n")


def rows(*columns):
    return "\n".join(
        ",".join(f"{value!r}" for value in line) for line in zip(*(c.tolist() for c in columns), strict=True)
    )


TABLES = {
    "Hz, m/N, deg": ("frequency [Hz],magnitude [m/N],phase [deg]", (F, np.abs(G), np.angle(G, deg=True))),
    "rad/s, mm/N, rad": ("omega (rad/s),gain (mm/N),phase (rad)", (2 * np.pi * F, 1e3 * np.abs(G), np.angle(G))),
    "kHz, dB, deg": ("f [kHz],mag [dB],phase [deg]", (F / 1e3, 20 * np.log10(np.abs(G)), np.angle(G, deg=True))),
    "dB over um/N": ("f [Hz],mag [dB re um/N],phase [rad]", (F, 20 * np.log10(1e6 * np.abs(G)), np.angle(G))),
    "parts in um/N": ("freq [Hz],real [um/N],imag [um/N]", (F, 1e6 * G.real, 1e6 * G.imag)),
}


@pytest.mark.parametrize("head, columns", TABLES.values(), ids=TABLES)
def test_units_of_analyzers_are_read(tmp_path, head, columns):
    (tmp_path / "table.csv").write_text(f"{head}\n{rows(*columns)}\n")
    read = zwidth.MeasuredDevice.read(tmp_path / "table.csv")
    # Conversion from decibels and angles has rounding errors.
    np.testing.assert_allclose(read.frequency, F, rtol=1e-14)
    np.testing.assert_allclose(read.response, G, rtol=1e-12)


def test_complex_numbers_with_i_are_read(tmp_path):
    lines = [f"{f!r};{g.real!r}{g.imag:+.17g}i" for f, g in zip(F.tolist(), G.tolist(), strict=True)]
    (tmp_path / "table.csv").write_text("\n".join(["frequency [Hz];response [m/N]", *lines]))
    np.testing.assert_allclose(zwidth.MeasuredDevice.read(tmp_path / "table.csv").response, G, rtol=1e-15)


PREAMBLE = "Analyzer 7, averages: 20\nwindow: none\n\n"
BLANKS = "\n".join(f"{f!r}  {g.real!r} {g.imag!r}" for f, g in zip(F.tolist(), G.tolist(), strict=True))
FILES = {
    "blanks": "f_Hz  real_m/N  imag_m/N\n" + BLANKS,
    "preamble": PREAMBLE + "freq [Hz],re [m/N],im [m/N]\n" + rows(F, G.real, G.imag),
    "line of units": "freq,real,imag\nHz,m/N,m/N\n" + rows(F, G.real, G.imag),
    "header in comment": "# f/Hz real imag\n" + BLANKS,
}


@pytest.mark.parametrize("text", FILES.values(), ids=FILES)
def test_text_formats_are_read(tmp_path, text):
    (tmp_path / "table.csv").write_text(text)
    read = zwidth.MeasuredDevice.read(tmp_path / "table.csv")
    np.testing.assert_array_equal(read.frequency, F)
    np.testing.assert_array_equal(read.response, G)


def test_arrays_of_numpy_and_matlab_are_read(tmp_path):
    np.savez(tmp_path / "table.npz", f_Hz=F, H=G, deviation=np.abs(G))
    scipy.io.savemat(tmp_path / "table.mat", {"omega_rad/s": 1.0, "f_Hz": F, "H": G, "deviation": np.abs(G)})
    for name in ("table.npz", "table.mat"):
        assert zwidth.MeasuredDevice.read(tmp_path / name) == device(deviation=np.abs(G))
    # In a log, complex numbers are rejected.
    np.savez(tmp_path / "log.npz", t=F, x=G, F=F)
    with pytest.raises(InputError, match="got complex numbers in 'x'"):
        read_log(tmp_path / "log.npz", {"time": "t:s", "position": "x:m", "force": "F:N"})


BAD_TABLES = {
    "no phase unit": ("frequency [Hz],magnitude [m/N],phase", "no unit for column phase"),
    "no frequency unit": ("frequency,magnitude [m/N],phase [deg]", "no unit for column frequency"),
    "velocity": ("frequency [Hz],magnitude [m/s],phase [deg]", "got m/s for column magnitude"),
    "no phase": ("frequency [Hz],magnitude [m/N],force [N]", "required are"),
    "two phases": ("frequency [Hz],phase [deg],arg [deg]", "rename one"),
}


@pytest.mark.parametrize("head, message", BAD_TABLES.values(), ids=BAD_TABLES)
def test_incomplete_tables_are_rejected(tmp_path, head, message):
    (tmp_path / "table.csv").write_text(f"{head}\n{rows(F, np.abs(G), np.angle(G))}\n")
    with pytest.raises(InputError, match=message):
        zwidth.MeasuredDevice.read(tmp_path / "table.csv")


def test_cell_that_is_not_a_number_is_reported_by_its_line(tmp_path):
    (tmp_path / "table.csv").write_text("frequency [Hz],real [m/N],imag [m/N]\n1,2,3\n2,overload,3\n")
    with pytest.raises(InputError, match=r"table.csv:3: got 'overload' under 'real \[m/N\]'"):
        zwidth.MeasuredDevice.read(tmp_path / "table.csv")
