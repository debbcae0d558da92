"""Help texts of the options and configuration keys that select the columns of a log file (recorded samples)."""

OF_LOGS = {
    "time": "Time column: HEADER, HEADER:ms, or HEADER:s+HEADER:ns for two columns. Default: recognized by its header.",
    "position": "Position column: HEADER, or with a unit HEADER:mm, HEADER:counts or HEADER:deg.",
    "force": "Column of the commanded force: HEADER, or with a unit HEADER:mN; for a torque HEADER:'mN m'.",
    "resolution": "Encoder resolution, e.g. 0.03mm, 0.09deg or '4000 counts/rev'.",
    "motor_constant": "Motor constant, i.e. force per ampere, e.g. 5N/A, if the force column is a current in A.",
}
