"""Test the file formats of logs: texts, arrays of NumPy and MATLAB, workbooks, velocities and motor currents."""

import gzip
import re
import zipfile

import numpy as np
import pytest
from scipy.io import savemat

from zwidth.core.errors import InputError
from zwidth.identification.columns import read_log

TIME = np.array([0.0, 0.001, 0.002])
POSITION, FORCE = np.array([0.0015, -0.002, 0.0]), np.array([0.5, -1.25, 3.0])
ROWS = "0,1.5,500\n1,-2,-1250\n2,0,3000\n"
BLANKS = "0 1.5 500\n 1  -2\t-1250\n2 0 3000\n".replace("\t", " ")
NUMBERED = {"time": "1:ms", "position": "2:mm", "force": "3:mN"}

TEXTS = {
    "blanks": ("time [ms]  x [mm]   F [mN]\n" + BLANKS, {}),
    "blanks, aligned columns": ("t_ms x_mm  F_mN\n   0   1.5   500\n   1    -2 -1250\n   2     0  3000\n", {}),
    "blanks and decimal commas": ("t_ms x_mm F_mN\n0 1,5 500\n1 -2,0 -1250\n2 0,0 3000\n", {}),
    "header in comment, as by numpy.savetxt": ("# t_ms x_mm F_mN\n" + BLANKS, {}),
    "header in MATLAB comment": ("% t_ms, x_mm, F_mN\n" + ROWS, {}),
    "underscores": ("time_ms,pos_mm,force_mN\n" + ROWS, {}),
    "slashes": ("time/ms,position / mm,force/mN\n" + ROWS, {}),
    "unit after blank": ("time ms,x mm,F mN\n" + ROWS, {}),
    "columns by names without units": (
        "clock_ms,encoder_mm,motor/mN\n" + ROWS,
        {"time": "clock", "position": "encoder", "force": "motor"},
    ),
    "line of units": ("time,x,F\nms,mm,mN\n" + ROWS, {}),
    "line of units in brackets": ("time,x,F\n[ms],[mm],[mN]\n" + ROWS, {}),
    "line of units, additional columns": (
        "time,x,temp,F\nms,mm,degC,mN\n0,1.5,20,500\n1,-2,20,-1250\n2,0,20,3000\n",
        {},
    ),
    "line of units and unit in name": ("time;x [mm];F;\nms;mm;mN\n0;1,5;500\n1;-2;-1250;\n2;0;3000\n", {}),
    "preamble": ("Recorder 7\nDate,2024-05-01\nSample rate,1000\n\nt [ms],x [mm],F [mN]\n" + ROWS, {}),
    "preamble with other separators": ("Recorder: 7\nAxis; 1; of 2\n#\nt [ms],x [mm],F [mN]\n" + ROWS, {}),
    "preamble and line of units": ("Channels,3\ntime,x,F\nms,mm,mN\n" + ROWS, {}),
    "no header": (ROWS, NUMBERED),
    "no header, blanks": (BLANKS, NUMBERED),
    "ISO 8601 times": (
        "time,x [mm],F [mN]\n2024-05-01T23:59:59.999,1.5,500\n2024-05-02T00:00:00,-2,-1250\n"
        "2024-05-02T00:00:00.001,0,3000\n",
        {},
    ),
    "times with blank and time zone": (
        "time,x [mm],F [mN]\n2024-05-01 10:00:00.000+02:00,1.5,500\n2024-05-01 10:00:00.001+02:00,-2,-1250\n"
        "2024-05-01 10:00:00.002+02:00,0,3000\n",
        {},
    ),
    "times of day": ("t;x [mm];F [mN]\n10:00:00,000;1,5;500\n10:00:00,001;-2;-1250\n10:00:00,002;0;3000\n", {}),
    "text column, quoted header": (
        't [ms],"state, of it",x [mm],F [mN]\n0,"on, yes",1.5,500\n1,off,-2,-1250\n2,off,0,3000\n',
        {},
    ),
    "micro sign": ("t (µs),x (µm),F [mN]\n0,1500,500\n1000,-2000,-1250\n2000,0,3000\n", {}),
}


def assert_log(log, positions=POSITION):
    for column, expected in ((log.time, TIME), (log.position, positions), (log.force, FORCE)):
        np.testing.assert_allclose(column, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("name", TEXTS)
def test_text_files_are_read(name, tmp_path):
    text, columns = TEXTS[name]
    file = tmp_path / "log.txt"
    file.write_text(text, encoding="utf-8")
    assert_log(read_log(file, columns))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
@pytest.mark.parametrize("compressed", [False, True])
def test_encodings_and_gzip_are_read(encoding, compressed, tmp_path):
    raw = TEXTS["micro sign"][0].encode(encoding)
    file = tmp_path / "log.csv"
    file.write_bytes(gzip.compress(raw) if compressed else raw)
    assert_log(read_log(file, {}))


def save_arrays(file, kind):
    columns = {"t_ms": 1e3 * TIME, "x_mm": 1e3 * POSITION, "F": FORCE}
    if kind == "columns.npz":
        np.savez(file, **columns, period=1e-3, note="by hand")
    elif kind == "packed.npz":
        np.savez_compressed(file, **columns)
    elif kind == "times.npz":
        moments = np.datetime64("2024-05-01T10:00:00") + (1e3 * TIME).astype("timedelta64[ms]")
        np.savez(file, time=moments, x_mm=1e3 * POSITION, F=FORCE)
    elif kind == "named.npy":
        rows = list(zip(*columns.values(), strict=True))
        np.save(file, np.array(rows, dtype=[(name, float) for name in columns]))
    elif kind == "matrix.npy":
        np.save(file, np.column_stack([1e3 * TIME, 1e3 * POSITION, 1e3 * FORCE]).astype(np.float64))
    elif kind == "columns.mat":
        savemat(file, {**columns, "Ts": 1e-3})
    else:
        savemat(file, {"log": np.column_stack([1e3 * TIME, 1e3 * POSITION, 1e3 * FORCE])})


@pytest.mark.parametrize(
    "kind", ["columns.npz", "packed.npz", "times.npz", "named.npy", "matrix.npy", "columns.mat", "matrix.mat"]
)
def test_arrays_of_numpy_and_matlab_are_read(kind, tmp_path):
    file = tmp_path / kind
    save_arrays(file, kind)
    assert_log(read_log(file, NUMBERED if kind.startswith("matrix") else {}))


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
def test_velocities_are_integrated(head, rows, columns, resolution, rotary, tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(f"{head}\n{rows}")
    log = read_log(file, columns, resolution=resolution)
    # The integrals in m or rad.
    assert_log(log, POSITION * (2 * np.pi / 60 if "rpm" in str(columns) else 1.0))
    assert log.rotary == rotary


@pytest.mark.parametrize(
    "head, constant, rotary, position",
    [
        ("t_ms,x_mm,current_A", "2.5 N/A", False, 1.0),
        ("t_ms,x_mm,current [mA]", "2.5 kN/A", False, 1.0),
        ("t_ms,x_rad,iq", "2500 mN m / A", True, 1e3),
    ],
)
def test_current_is_converted_by_the_motor_constant(head, constant, rotary, position, tmp_path):
    file = tmp_path / "log.csv"
    file.write_text(head + "\n0,1.5,.2\n1,-2,-.5\n2,0,1.2\n")
    log = read_log(file, {}, motor_constant=constant)
    assert_log(log, position * POSITION)
    assert log.rotary == rotary


def pack_sheet(stream):
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("xl/workbook.xml", "<x/>")


REFUSED = {
    "workbook": (pack_sheet, "save the sheet as CSV"),
    "workbook in old format": (b"\xd0\xcf\x11\xe0" + bytes(20), "save the sheet as CSV"),
    "image": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "it is not a text"),
    "truncated gzip": (gzip.compress(ROWS.encode())[:-9], "compress it again"),
    "current without motor constant": (b"t,x,current_A\n0,1,2\n", "motor_constant: got nothing for a force in A"),
    "invalid time": (b"t;x;F\n10:00:00;1;2\n10:00:6x;1;2\n", ":3: got '10:00:6x' under 't'; a time"),
    "time out of range": (b"t;x;F\n10:00:00;1;2\n10:00:61;1;2\n", ":3: got '10:00:61' under 't'; a time"),
    "text between blanks": (b"t x F\n0 1 2\n1 no 3\n", ":3: got 'no' under 'x'; a number is needed"),
    "Python objects": (lambda stream: np.save(stream, np.array([{}, 1], dtype=object)), "got Python objects"),
    "scalar array": (lambda stream: np.savez(stream, a=1.0), "a (); save a column of numbers for each"),
    "unequal lengths": (
        lambda stream: np.savez(stream, t=TIME, x=POSITION[:2], F=FORCE),
        "'t' 3, 'x' 2, 'F' 3; save one value",
    ),
    "no number": (lambda stream: np.savez(stream, t=TIME, x=3 * [np.nan], F=FORCE), "column 'x' contains no number"),
    "no header": (lambda stream: np.save(stream, np.eye(3)), "its columns have no names; add a header such as"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_unreadable_files_are_rejected_with_one_line_message(name, tmp_path):
    content, message = REFUSED[name]
    file = tmp_path / "log.dat"
    with file.open("wb") as stream:
        stream.write(content) if isinstance(content, bytes) else content(stream)
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        read_log(file, {})
    assert "\n" not in str(caught.value)
    assert "log.dat" in str(caught.value) or "motor_constant" in str(caught.value)


def test_damaged_matlab_5_file_is_rejected(tmp_path):
    file = tmp_path / "log.mat"
    file.write_bytes(b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(InputError, match="no readable arrays"):
        read_log(file, {})


def test_matlab_7_3_file_is_rejected_with_instructions(tmp_path):
    file = tmp_path / "log.mat"
    # The header before the HDF5 data in such files: text, no subsystem data, version 2, byte order.
    file.write_bytes(
        b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + bytes(8) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n"
    )
    with pytest.raises(InputError, match=r"log.mat: got MATLAB format 7.3; save it again with save\('log.mat'"):
        read_log(file, {})


def test_invalid_motor_constant_is_rejected(tmp_path):
    file = tmp_path / "log.csv"
    file.write_text("t,x,i_A\n" + ROWS)
    with pytest.raises(InputError, match="motor_constant: got '5 kg/A' for a force in A; give the force per ampere"):
        read_log(file, {"force": "i_A"}, motor_constant="5 kg/A")
