"""Test the recognition of columns in log files with unusual formats, and the messages for files that are rejected."""

import math

import numpy as np
import pytest

from zwidth.core.errors import InputError
from zwidth.identification.columns import fit_motions, read_log

# Time in s, position in m or rad, and force in N or N m of every accepted file below.
TIME, POSITION, FORCE = [0.0, 0.001], [0.0015, -0.002], [0.5, -1.25]
ANGLE = [math.radians(1.5), math.radians(-2.0)]

READ = {
    "si": ("time,position,force\n0,0.0015,0.5\n0.001,-0.002,-1.25\n", {}, POSITION),
    "units": ("t [ms],x [mm],F [mN]\n0,1.5,500\n1,-2,-1250\n", {}, POSITION),
    "round brackets": ("t (us),x (um),F (kN)\n0,1500,5e-4\n1e3,-2000,-1.25e-3\n", {}, POSITION),
    "other order and columns": ("F,i,note,x [mm],t [ms]\n0.5,1,a b,1.5,0\n-1.25,2,,-2,1\n", {}, POSITION),
    "columns by option": (
        "a,b,c\n0,1.5,0.5\n1,-2,-1.25\n",
        {"time": "a:ms", "position": "b:mm", "force": "c"},
        POSITION,
    ),
    "unit of option overrides header": (
        "t [s],x,F\n0,1.5,0.5\n1,-2,-1.25\n",
        {"time": "t:ms", "position": "x:mm"},
        POSITION,
    ),
    "colon in name": ("t:a,x,F\n0,1.5,0.5\n0.001,-2,-1.25\n", {"time": "t:a", "position": "x:mm"}, POSITION),
    "headers with units as names": (
        "clock [ms],x [mm],x,F [N]\n0,1.5,7,0.5\n1,-2,7,-1.25\n",
        {"position": "x [mm]", "time": "clock [ms]"},
        POSITION,
    ),
    "tabs": ("t [ms]\tx [mm]\tforce, filtered [N]\n0\t1.5\t.5\n1\t-2\t-1.25\n", {"force": "force, filtered"}, POSITION),
    "german": ("t [ms];x [mm];F [N]\n0;1,5;0,5\n1;-2,0;-1,25\n", {}, POSITION),
    "sep= line": ("\ufeffsep=;\r\nt [ms];x [mm];F [N]\r\n0;1,5;0,5\r\n1;-2,0;-1,25\r\n", {}, POSITION),
    "comments, blanks, byte-order mark": (
        "\ufeff# made by hand\n\n# twice\n t [ms] , x [mm] ,F\n0 ,1.5, .5\n\n1, -2 ,-1.25\n",
        {},
        POSITION,
    ),
    "quotes": (
        '"t [ms]","x [mm]","F, in newtons"\r\n0,"1.5",0.5\r\n1,-2,-1.25\r\n',
        {"force": "F, in newtons"},
        POSITION,
    ),
    "degrees": ("t [ms],angle [deg],torque [N m]\n0,1.5,0.5\n1,-2,-1.25\n", {}, ANGLE),
    "degree sign": ("t [ms];phi (°);tau (mNm)\n0;1,5;500\n1;-2;-1250\n", {}, ANGLE),
    "rotary units by option": (
        "t [ms],phi,tau\n0,3,5e1\n1,-4,-125\n",
        {"position": "phi:deg", "force": "tau:N cm"},
        [2 * x for x in ANGLE],
    ),
}


def write(tmp_path, text, name="log.csv"):
    file = tmp_path / name
    file.write_bytes(text if isinstance(text, bytes) else text.encode("utf-8"))
    return file


@pytest.mark.parametrize("name", READ)
def test_unusual_files_are_read(name, tmp_path):
    text, columns, positions = READ[name]
    log = read_log(write(tmp_path, text), columns)
    assert log.time is not None
    for column, expected in ((log.time, TIME), (log.position, positions), (log.force, FORCE)):
        np.testing.assert_allclose(column, expected, rtol=1e-15)
    assert log.rotary == (positions is not POSITION)
    assert log.resolution is None


@pytest.mark.parametrize(
    "head, resolution, step, rotary",
    [
        ("t,encoder [counts],F", "0.03mm", 3e-5, False),
        ("t,encoder [ticks],F", 3e-5, 3e-5, False),
        ("t,encoder [Counts],torque [mN m]", "0.09 deg", math.radians(0.09), True),
        ("t,encoder [counts],torque [mN m]", "1e-3", 1e-3, True),
    ],
)
def test_counts_are_converted_by_the_resolution(head, resolution, step, rotary, tmp_path):
    log = read_log(write(tmp_path, f"{head}\n0,7,1\n1,-3,2\n"), {}, resolution=resolution)
    assert (log.resolution, log.rotary) == (pytest.approx(step, rel=1e-15), rotary)
    np.testing.assert_allclose(log.position, [7 * step, -3 * step], rtol=1e-15)


def test_resolution_is_stored_for_position_in_length_units(tmp_path):
    log = read_log(write(tmp_path, "t,x [mm],F\n0,7,1\n1,-3,2\n"), {}, resolution="30 um")
    assert log.resolution == 3e-5
    assert log.position.tolist() == [7e-3, -3e-3]


def test_time_column_is_optional_if_period_is_given(tmp_path):
    assert read_log(write(tmp_path, "x,F\n0,7\n1,-3\n"), {}, period=1e-3).time is None


def test_period_contradicted_by_times_is_rejected(tmp_path):
    log = write(tmp_path, "t [ms],x,F\n0,7,1\n2,-3,2\n4,-3,2\n")
    with pytest.raises(InputError, match=r"period: got 1\.000 ms, but the times in .* are 2\.000 ms apart"):
        read_log(log, {}, period=1e-3)
    assert read_log(log, {}, period=2.1e-3).time is None
    # Times without a unit are not compared, and an unreadable time column is a reason to give the period.
    for text in ("t,x,F\n0,7,1\n2,-3,2\n", "t [ms],x,F\n0,7,1\nbad,-3,2\n"):
        assert read_log(write(tmp_path, text), {}, period=1e-3).time is None


REFUSED = {
    "empty": ("", {}, "it is empty"),
    "only comments": ("# t,x,F\n", {}, "it is empty"),
    "no samples": ("t,x,F\n", {}, "column names without samples"),
    "no header": ("0,1,2\n1,2,3\n", {}, "log.csv:1: got numbers where the names"),
    "header in comment": ("# t,x,F\n0;1,5;2\n1;2;3\n", {}, "log.csv:2: got numbers where the names"),
    "one column": ("t\n0\n", {}, "log.csv:1: got 't'; separate the columns"),
    "text": ("# r\nt,x,F\n0,1,2\n1,no,3\n", {}, "log.csv:4: got 'no' under 'x'; a number is needed"),
    "an empty column": ("t,x,F\n0,,2\n", {}, "column 'x' contains no number"),
    "not finite": ("t,x,F\n0,nan,2\n", {}, "column 'x' contains no number"),
    "too large": ("t,x,F\n0,1,1e999\n", {}, "log.csv:2: got '1e999' under 'F'"),
    "underscores": ("t,x,F\n0,1,1_000\n", {}, "log.csv:2: got '1_000' under 'F'"),
    "thousands separator": ("t;x;F\n0;1.000,5;1\n", {}, "log.csv:2: got '1.000,5' under 'x'"),
    "thousands and points": ("t;x;F\n0;1,000;0.5\n", {}, "log.csv:2: got '0.5', and '1,000' in line 2; all numbers"),
    "commas and points": ("t x F\n0 1,5 1\n1 2.5 1\n", {}, "log.csv:3: got '2.5', and '1,5' in line 2; all numbers"),
    "comment among samples": ("t,x,F\n0,1,2\n# gap\n1,2,3\n", {}, "log.csv:3: got '# gap' under 't'"),
    "commas as both": ("t,x,F\n0,1,5,2\n", {}, "got 4 cells for 3 columns; a comma as decimal sign"),
    "not UTF-8": (b"\xff\xfet,x,F", {}, "not a text in UTF-8"),
    "no such column": ("t,xpos,F\n0,1,2\n", {"position": "xpso"}, "no column 'xpso'; did you mean 'xpos'?"),
    "ambiguous": ("t,x,angle,F\n0,1,2,3\n", {}, "position: may be any of the columns 'x', 'angle' in"),
    "unrecognized name": ("t,y,F\n0,1,2\n", {}, "position: no column for position recognized in"),
    "duplicate name": ("t,a,a,F\n0,1,2,3\n", {"position": "a"}, "has 2 columns 'a'"),
    "shared": ("t,x\n0,1\n", {"force": "x"}, "the same column is used twice: time 't', position 'x', force 'x'"),
    "unit in the header": ("t,x [furlong],F\n0,1,2\n", {}, "position: got the unit 'furlong'; allowed are m, cm"),
    "unit in the option": ("t,x,F\n0,1,2\n", {"time": "t:N"}, "time: got the unit 'N'; allowed are s, ms"),
    "counts without resolution": ("t,x [counts],F\n0,1,2\n", {}, "specify the resolution, as 0.03 mm"),
    "length and torque": ("t,x [mm],tau [N m]\n0,1,2\n", {}, "got a position in mm with a torque in N m"),
    "angle and force": ("t,phi [deg],F\n0,1,2\n", {}, "a position in deg with a force in N (no unit)"),
    "length without unit": ("t,weg,tau [N m]\n0,1,2\n", {}, "in m (no unit) with a torque in N m"),
    "no column recognized": ("a,b,c\n0,1,2\n1,2,3\n", {}, "no column for time, position and force recognized in"),
    "two unknown": ("t,b,c\n0,1,2\n1,2,3\n", {}, "among 't', 'b', 'c'; specify position 'COLUMN:unit', force"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_unreadable_files_are_rejected(name, tmp_path):
    text, columns, message = REFUSED[name]
    with pytest.raises(InputError) as caught:
        read_log(write(tmp_path, text), columns)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "resolution, message",
    [
        ("0.1 deg", "an angle belongs to a torque"),
        ("0.1 kg", "resolution: got '0.1 kg'"),
        (-1.0, "resolution: got -1 m"),
        ("0", "resolution: got 0 m"),
    ],
)
def test_invalid_resolution_is_rejected(resolution, message, tmp_path):
    with pytest.raises(InputError, match=message):
        read_log(write(tmp_path, "t,x [counts],F\n0,7,1\n"), {}, resolution=resolution)


def test_logs_of_different_axes_or_resolutions_are_rejected(tmp_path):
    linear = read_log(write(tmp_path, "t,x,F\n0,7,1\n"), {})
    turning = read_log(write(tmp_path, "t,phi [deg],tau [N m]\n0,7,1\n"), {})
    coarse = read_log(write(tmp_path, "t,x,F\n0,7,1\n"), {}, resolution="1 mm")
    with pytest.raises(InputError, match="fit them separately"):
        fit_motions([linear, turning])
    with pytest.raises(InputError, match="resolution: the logs have different ones"):
        fit_motions([linear, coarse])
