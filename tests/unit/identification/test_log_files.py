"""Logs as programs write them: texts of many kinds, arrays of NumPy and MATLAB, workbooks, velocities and currents."""

import gzip
import re
import zipfile

import numpy as np
import pytest
from scipy.io import savemat

from zwidth.core.errors import InputError
from zwidth.identification.columns import read_log

TIME = np.array([0.0, 0.001, 0.002])
PLACE, FORCE = np.array([0.0015, -0.002, 0.0]), np.array([0.5, -1.25, 3.0])
ROWS = "0,1.5,500\n1,-2,-1250\n2,0,3000\n"
BLANKS = "0 1.5 500\n 1  -2\t-1250\n2 0 3000\n".replace("\t", " ")
NUMBERED = {"time": "1:ms", "position": "2:mm", "force": "3:mN"}

TEXTS = {
    "blanks": ("time [ms]  x [mm]   F [mN]\n" + BLANKS, {}),
    "blanks, lined up": ("t_ms x_mm  F_mN\n   0   1.5   500\n   1    -2 -1250\n   2     0  3000\n", {}),
    "blanks and decimal commas": ("t_ms x_mm F_mN\n0 1,5 500\n1 -2,0 -1250\n2 0,0 3000\n", {}),
    "a remark names the columns, as of numpy.savetxt": ("# t_ms x_mm F_mN\n" + BLANKS, {}),
    "a remark of MATLAB": ("% t_ms, x_mm, F_mN\n" + ROWS, {}),
    "underscores": ("time_ms,pos_mm,force_mN\n" + ROWS, {}),
    "slashes": ("time/ms,position / mm,force/mN\n" + ROWS, {}),
    "a unit behind a blank": ("time ms,x mm,F mN\n" + ROWS, {}),
    "names without their units are asked for": (
        "clock_ms,encoder_mm,motor/mN\n" + ROWS,
        {"time": "clock", "position": "encoder", "force": "motor"},
    ),
    "units in a line": ("time,x,F\nms,mm,mN\n" + ROWS, {}),
    "units in brackets in a line": ("time,x,F\n[ms],[mm],[mN]\n" + ROWS, {}),
    "units in a line, further columns": (
        "time,x,temp,F\nms,mm,degC,mN\n0,1.5,20,500\n1,-2,20,-1250\n2,0,20,3000\n",
        {},
    ),
    "units in a line and in a name": ("time;x [mm];F;\nms;mm;mN\n0;1,5;500\n1;-2;-1250;\n2;0;3000\n", {}),
    "a preamble": ("Recorder 7\nDate,2024-05-01\nSample rate,1000\n\nt [ms],x [mm],F [mN]\n" + ROWS, {}),
    "a preamble of other separators": ("Recorder: 7\nAxis; 1; of 2\n#\nt [ms],x [mm],F [mN]\n" + ROWS, {}),
    "a preamble and units in a line": ("Channels,3\ntime,x,F\nms,mm,mN\n" + ROWS, {}),
    "no names": (ROWS, NUMBERED),
    "no names between blanks": (BLANKS, NUMBERED),
    "times of a calendar": (
        "time,x [mm],F [mN]\n2024-05-01T23:59:59.999,1.5,500\n2024-05-02T00:00:00,-2,-1250\n"
        "2024-05-02T00:00:00.001,0,3000\n",
        {},
    ),
    "times with a blank and a zone": (
        "time,x [mm],F [mN]\n2024-05-01 10:00:00.000+02:00,1.5,500\n2024-05-01 10:00:00.001+02:00,-2,-1250\n"
        "2024-05-01 10:00:00.002+02:00,0,3000\n",
        {},
    ),
    "times of a day": ("t;x [mm];F [mN]\n10:00:00,000;1,5;500\n10:00:00,001;-2;-1250\n10:00:00,002;0;3000\n", {}),
    "a column of text, a quoted one": (
        't [ms],"state, of it",x [mm],F [mN]\n0,"on, yes",1.5,500\n1,off,-2,-1250\n2,off,0,3000\n',
        {},
    ),
    "micro sign": ("t (µs),x (µm),F [mN]\n0,1500,500\n1000,-2000,-1250\n2000,0,3000\n", {}),
}


def check(found, place=PLACE):
    for column, expected in ((found.time, TIME), (found.position, place), (found.force, FORCE)):
        np.testing.assert_allclose(column, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", TEXTS)
def test_texts_are_read(name, tmp_path):
    text, columns = TEXTS[name]
    file = tmp_path / "log.txt"
    file.write_text(text, encoding="utf-8")
    check(read_log(file, columns))


@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
@pytest.mark.parametrize("packed", [False, True])
def test_codings_and_gzip_are_read(coding, packed, tmp_path):
    raw = TEXTS["micro sign"][0].encode(coding)
    file = tmp_path / "log.csv"
    file.write_bytes(gzip.compress(raw) if packed else raw)
    check(read_log(file, {}))


def save_arrays(file, kind):
    columns = {"t_ms": 1e3 * TIME, "x_mm": 1e3 * PLACE, "F": FORCE}
    if kind == "columns.npz":
        np.savez(file, **columns, period=1e-3, note="by hand")
    elif kind == "packed.npz":
        np.savez_compressed(file, **columns)
    elif kind == "times.npz":
        moments = np.datetime64("2024-05-01T10:00:00") + (1e3 * TIME).astype("timedelta64[ms]")
        np.savez(file, time=moments, x_mm=1e3 * PLACE, F=FORCE)
    elif kind == "named.npy":
        rows = list(zip(*columns.values(), strict=True))
        np.save(file, np.array(rows, dtype=[(name, float) for name in columns]))
    elif kind == "matrix.npy":
        np.save(file, np.column_stack([1e3 * TIME, 1e3 * PLACE, 1e3 * FORCE]).astype(np.float64))
    elif kind == "columns.mat":
        savemat(file, {**columns, "Ts": 1e-3})
    else:
        savemat(file, {"log": np.column_stack([1e3 * TIME, 1e3 * PLACE, 1e3 * FORCE])})


@pytest.mark.parametrize(
    "kind", ["columns.npz", "packed.npz", "times.npz", "named.npy", "matrix.npy", "columns.mat", "matrix.mat"]
)
def test_arrays_of_numpy_and_matlab_are_read(kind, tmp_path):
    file = tmp_path / kind
    save_arrays(file, kind)
    check(read_log(file, NUMBERED if kind.startswith("matrix") else {}))


@pytest.mark.parametrize(
    "head, rows, columns, resolution, rotary",
    [
        ("t_ms,velocity_mm/s,F", "0,1500,.5\n1,-3500,-1.25\n2,2e3,3\n", {}, None, False),
        ("t_ms,vel,F", "0,1.5,.5\n1,-3.5,-1.25\n2,2,3\n", {}, None, False),
        ("t_ms,n,F", "0,3e4,.5\n1,-7e4,-1.25\n2,4e4,3\n", {"position": "n:counts/s"}, "50 um", False),
        ("t_ms,w [rad/s],tau [N m]", "0,1.5,.5\n1,-3.5,-1.25\n2,2,3\n", {"position": "w"}, None, True),
        ("t_ms,n,tau_Nm", "0,1.5,.5\n1,-3.5,-1.25\n2,2,3\n", {"position": "n:rpm"}, None, True),
    ],
)  # fmt: skip
def test_velocities_are_summed_up(head, rows, columns, resolution, rotary, tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(f"{head}\n{rows}")
    found = read_log(file, columns, resolution=resolution)
    # What the numbers above are in m, or in rad.
    check(found, PLACE * (2 * np.pi / 60 if "rpm" in str(columns) else 1.0))
    assert found.rotary == rotary


@pytest.mark.parametrize(
    "head, constant, rotary, position",
    [
        ("t_ms,x_mm,current_A", "2.5 N/A", False, 1.0),
        ("t_ms,x_mm,current [mA]", "2.5 kN/A", False, 1.0),
        ("t_ms,x_rad,iq", "2500 mN m / A", True, 1e3),
    ],
)
def test_a_current_is_a_force_by_its_motor(head, constant, rotary, position, tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(head + "\n0,1.5,.2\n1,-2,-.5\n2,0,1.2\n")
    found = read_log(file, {}, motor_constant=constant)
    check(found, position * PLACE)
    assert found.rotary == rotary


def pack_sheet(opened):
    with zipfile.ZipFile(opened, "w") as archive:
        archive.writestr("xl/workbook.xml", "<x/>")


REFUSED = {
    "a workbook": (pack_sheet, "save the sheet as CSV"),
    "an old workbook": (b"\xd0\xcf\x11\xe0" + bytes(20), "save the sheet as CSV"),
    "a picture": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "it is not a text"),
    "half of a gzip": (gzip.compress(ROWS.encode())[:-9], "compress it again"),
    "a current alone": (b"t,x,current_A\n0,1,2\n", "motor_constant: got nothing for a force in A"),
    "no time": (b"t;x;F\n10:00:00;1;2\n10:00:6x;1;2\n", ":3: got '10:00:6x' under 't'; a time"),
    "no such time": (b"t;x;F\n10:00:00;1;2\n10:00:61;1;2\n", ":3: got '10:00:61' under 't'; a time"),
    "a cell between blanks": (b"t x F\n0 1 2\n1 no 3\n", ":3: got 'no' under 'x'; a number is needed"),
    "objects": (lambda opened: np.save(opened, np.array([{}, 1], dtype=object)), "got Python objects"),
    "no column": (lambda opened: np.savez(opened, a=1.0), "a (); save a column of numbers for each"),
    "lengths": (lambda opened: np.savez(opened, t=TIME, x=PLACE[:2], F=FORCE), "'t' 3, 'x' 2, 'F' 3; save one value"),
    "no number": (lambda opened: np.savez(opened, t=TIME, x=3 * [np.nan], F=FORCE), "column 'x' contains no number"),
    "no names": (lambda opened: np.save(opened, np.eye(3)), "its columns have no names; add a header such as"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_files_are_refused_in_a_line(name, tmp_path):
    made, words = REFUSED[name]
    file = tmp_path / "log.dat"
    with file.open("wb") as opened:
        opened.write(made) if isinstance(made, bytes) else made(opened)
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        read_log(file, {})
    assert "\n" not in str(caught.value)
    assert "log.dat" in str(caught.value) or "motor_constant" in str(caught.value)


def test_an_old_file_of_matlab_that_is_broken_is_refused(tmp_path):
    file = tmp_path / "log.mat"
    file.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(InputError, match="no readable arrays"):
        read_log(file, {})


def test_a_file_of_matlab_7_3_says_how_to_save_it(tmp_path):
    file = tmp_path / "log.mat"
    # The header that HDF5 follows in such files: text, nothing of a subsystem, version 2, and the order of bytes.
    file.write_bytes(
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n"
    )
    with pytest.raises(InputError, match=r"log.mat: got MATLAB format 7.3; save it again with save\('log.mat'"):
        read_log(file, {})


def test_a_motor_constant_that_is_none_is_told(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("t,x,i_A\n" + ROWS)
    with pytest.raises(InputError, match="motor_constant: got '5 kg/A' for a force in A; give the force per ampere"):
        read_log(file, {"force": "i_A"}, motor_constant="5 kg/A")
