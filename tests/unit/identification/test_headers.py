"""Test the recognition of log columns by the words and units in their headers."""

import numpy as np
import pytest

from zwidth.core.errors import InputError
from zwidth.identification.columns import read_log

TABLE = "0,1,2\n1,3,-1\n2,2,4\n"


def write_log(tmp_path, head, table=TABLE):
    file = tmp_path / "log.csv"
    file.write_text(f"{head}\n{table}")
    return file


@pytest.mark.parametrize(
    ("head", "scales", "rotary"),
    [
        ("stamp_us,phi_deg,tau_cmd_mNm", (1e-6, np.pi / 180, 1e-3), True),
        ("micros,angle [deg],torque_mNm", (1e-6, np.pi / 180, 1e-3), True),
        ("__time,/joint/position [rad],/joint/effort [N m]", (1.0, 1.0, 1.0), True),
        ("Time (s),Position (turns),Torque setpoint (Nm)", (1.0, 2 * np.pi, 1.0), True),
        ("Zeit [ms],Winkel [°],Sollmoment [mNm]", (1e-3, np.pi / 180, 1e-3), True),
        ("timestamp [s],encoder_paddle_pos [deg],motor_torque [N.m]", (1.0, np.pi / 180, 1.0), True),
        ("time,angle,torque", (1.0, 1.0, 1.0), True),
        ("t,phi,tau [mN m]", (1.0, 1.0, 1e-3), True),
        ("millis,mm,N", (1e-3, 1e-3, 1.0), False),
        ("Time (s),Position (mm),Applied Force (kg)", (1.0, 1e-3, 9.80665), False),
        ("Time (s),Position (mm),Applied Force (lbf)", (1.0, 1e-3, 4.4482216152605), False),
    ],
)
def test_columns_are_recognized_by_words(head, scales, rotary, tmp_path):
    log = read_log(write_log(tmp_path, head), {})
    columns = np.array([[0, 1, 2], [1, 3, 2], [2, -1, 4]], float)
    for column, expected, scale in zip((log.time, log.position, log.force), columns, scales, strict=True):
        assert column is not None
        np.testing.assert_allclose(column, expected * scale, rtol=1e-12)
    assert log.rotary == rotary


def test_commanded_force_and_measured_position_are_preferred(tmp_path):
    log = read_log(
        write_log(tmp_path, "t_ms,x_des_mm,x_meas_mm,force_meas_N,force_cmd_N", "0,9,1,8,5\n1,9,2,8,6\n"), {}
    )
    assert log.force.tolist() == [5, 6]
    assert read_log(write_log(tmp_path, "t,pos_cmd_mm,pos_mm,F", "0,9,1,8\n1,9,2,8\n"), {}).position.tolist() == [
        1e-3,
        2e-3,
    ]


def test_integers_without_unit_are_counts(tmp_path):
    file = write_log(tmp_path, "t_ms,angle,torque_Nm", "0,16000,1\n1,16100,2\n2,90,3\n")
    with pytest.raises(InputError, match="position: it is in counts; specify the resolution"):
        read_log(file, {})
    log = read_log(file, {}, resolution="14 bit")
    np.testing.assert_allclose(log.position, 2 * np.pi / 2**14 * np.array([16000, 16100, 90]), rtol=1e-15)
    with pytest.raises(InputError, match="write counts per turn as '16384 counts/rev'"):
        read_log(file, {}, resolution="16384")


def test_columns_by_number_with_seconds_and_nanoseconds(tmp_path):
    file = tmp_path / "log.csv"
    lines = [f"1700000000,{123456789 + 1000000 * k},,joint,{k}.5,{k}" for k in range(3)]
    file.write_text("\n".join(lines))
    log = read_log(file, {"time": "1:s+2:ns", "position": "5:rad", "force": "6:N m"})
    assert log.time is not None
    np.testing.assert_allclose(np.diff(log.time), 1e-3, rtol=1e-9)


def test_epoch_time_without_unit_is_scaled_by_its_magnitude(tmp_path):
    table = "".join(f"{1700000000000000000 + 1000000 * k},{k},{k}\n" for k in range(3))
    log = read_log(write_log(tmp_path, "time,x [mm],F [N]", table), {})
    assert log.time is not None
    np.testing.assert_allclose(np.diff(log.time), 1e-3, rtol=1e-3)
    assert "the time has no unit and is read in ns since 1970, according to its magnitude" in log.notes


def test_unit_that_contradicts_the_header_is_noted(tmp_path):
    file = write_log(tmp_path, "t_ms,x_mm,Applied Force (kg)")
    log = read_log(file, {"force": "Applied Force (kg):N"})
    assert log.force.tolist() == [2.0, -1.0, 4.0]
    assert "the force is read in N, as specified, although its header has kg" in log.notes


def test_labview_header_is_read(tmp_path):
    file = tmp_path / "log.lvm"
    file.write_text(
        "LabVIEW Measurement\t\nWriter_Version\t2\nSeparator\tTab\nDate\t2015/03/10\n***End_of_Header***\t\n\t\n"
        "Channels\t2\t\t\nSamples\t3\t3\t\nX_Dimension\tTime\tTime\t\nX0\t0.0E+0\t0.0E+0\t\n"
        "Delta_X\t0.001\t0.001\t\n***End_of_Header***\t\t\t\nTime\tposition [mm]\tforce [N]\tComment\n"
        "0.000\t1.5\t0.5\n0.001\t-2.0\t-1.25\n0.002\t0\t3\n"
    )
    log = read_log(file, {})
    np.testing.assert_allclose(log.position, [1.5e-3, -2e-3, 0.0])
