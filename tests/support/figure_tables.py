"""Tables of studies with synthetic columns, and the arguments of each function of `zwidth.plotting`."""

import numpy as np

from zwidth.plotting.table import stack


def outline(delta, d=0.0, line=False):
    """Return half an ellipse from (0, -delta) to (0, 2 + delta); with ``line``, its end is straight at omega = pi."""
    omega = np.linspace(0.0, np.pi if line else 2.0, 21)
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 21)
    alpha, beta = (1.0 + delta) * np.cos(angle), 1.0 + (1.0 + delta) * np.sin(angle)
    if line:
        alpha, beta, omega = np.append(alpha, 0.0), np.append(beta, 3.0), np.append(omega, np.pi)
        alpha[-2] = 0.5
    keys = {"curve": "boundary", "d": d, "delta": delta}
    return {**keys, "omega": omega, "alpha": alpha, "beta": beta}


def of_model(model):
    """Return the column of a delay model; none in tables of exact delays only."""
    return {"delay_model": model} if model else {}


def ridge(d=0.0, model="held"):
    delta = np.linspace(0.0, 10.0, 41)
    columns = {"alpha_max": (1.0 + delta) / (1.0 + d), "beta": 0.5 - 0.1 * delta, "omega": delta / 10}
    return {"d": d, **of_model(model), "delta": delta, **columns}


def path(d=0.0):
    columns_of_ridge = ridge(d, "")
    return {"curve": "ridge_path", **columns_of_ridge, "alpha": columns_of_ridge.pop("alpha_max")}


def interval(d=0.0, model="held", curve="stable"):
    delta = np.linspace(0.0, 2.0, 11)
    bounds = {"beta_lower": -delta, "beta_upper": 2.0 / (1.0 + d) + delta}
    return {"curve": curve, "d": d, **of_model(model), "delta": delta, **bounds}


def passive_outline(delta, d=0.0):
    columns = {"alpha": np.array([0.0, 2.0 * delta, 0.0]), "beta": np.array([-delta, 0.0, delta])}
    return {"curve": "passive", "d": d, "delta": delta, **columns}


def in_si(columns):
    """Return the columns with the walls in N/m and N s/m added."""
    walls = {"stiffness_N_per_m": 1e5 * columns["alpha"], "virtual_damping_N_s_per_m": 100.0 * columns["beta"]}
    return {**columns, **walls}


def cost(d):
    delta = np.linspace(0.0, 4.0, 17)
    return {"d": d, "delta": delta, "alpha_max": 1.0 + 3.0 * delta, "alpha_max_passive": 2.0 * delta / (1.0 + d)}


def response(label="a device", settling_time=0.03, physical=True):
    time = np.arange(100) * 1e-3
    position = 1e-4 * (1.0 - np.exp(-time / 0.01))
    columns = {"time_s": time, "position_m": position, "wall_force_N": -position / 1e-4}
    columns |= {"final_position_m": 1e-4, "settling_time_s": settling_time}
    if not physical:
        columns = {name.rpartition("_")[0]: column for name, column in columns.items()}
    return {"label": label, "alpha": 0.1, "beta": 0.4, "delta": 0.1, "d": 1.0, **columns}


def grid_map(deltas=(0.1,)):
    alpha, beta = np.linspace(0.0, 1.0, 6), np.linspace(-1.0, 1.0, 5)
    shape = (alpha.size, beta.size, len(deltas), 1)
    radius = 0.5 + np.broadcast_to(alpha[:, None, None, None] + beta[None, :, None, None] ** 2, shape)
    outputs = {"stable": radius < 1, "spectral_radius": radius, "passive": radius < 0.8}
    return {"alpha": alpha, "beta": beta, "delta": np.array(deltas), "d": np.array([1.0]), **outputs}


def measured_response():
    frequency = np.geomspace(1.0, 400.0, 60)
    response_values = 1.0 / (-0.1 * (2 * np.pi * frequency) ** 2 + 40j * np.pi * frequency)
    loop = 5e3 * response_values
    columns = {
        "real_m_per_N": response_values.real,
        "imag_m_per_N": response_values.imag,
        "deviation_m_per_N": np.full(60, 2e-6),
    }
    return {"frequency_Hz": frequency, **columns, "open_loop_real": loop.real, "open_loop_imag": loop.imag}


RESPONSE = measured_response()
BOUNDARY = stack([outline(0.5), outline(1.0), outline(0.5, 2.0), outline(1.0, 2.0), path(), path(2.0)])
RIDGE = stack([ridge(), ridge(0.5), ridge(0.5, "fractional_power")])
LIMITS = {0.0: 4.0, 0.5: 2.5}
SLOPES = {"d": np.linspace(0.0, 1.0, 9), "slope": 4.0 - 3.0 * np.linspace(0.0, 1.0, 9)}
COSTS = stack([cost(0.0), cost(1.0)])

# Arguments per figure; the key is the function's name and the special feature of the case.
_POSE = np.meshgrid(np.linspace(0.0, 120.0, 5), np.linspace(30.0, 150.0, 4))
POSES: dict[str, np.ndarray] = {"shoulder_deg": _POSE[0].ravel(), "elbow_deg": _POSE[1].ravel()}
POSES["stiffness_N_per_m"] = 1e4 + 50.0 * POSES["shoulder_deg"] + POSES["elbow_deg"] ** 2
SCATTERED = {name: column[:-3] for name, column in POSES.items()}

EVERY_FIGURE = {
    "draw_boundary": (BOUNDARY,),
    "draw_boundary with a line": (stack([outline(1.0), outline(3.0, line=True)]),),
    "draw_boundary with passivity in SI": (in_si(stack([outline(0.5), passive_outline(0.5)])),),
    "draw_boundary of many deltas": (stack([outline(delta) for delta in np.linspace(0.1, 2.0, 20)]),),
    "draw_zero_stiffness": (
        stack([interval(), interval(0.5), interval(0.5, "fractional_power"), interval(3.0, curve="passive")]),
    ),
    "draw_zero_stiffness of exact delays": (stack([interval(0.5, ""), interval(3.0, "", "passive")]),),
    "draw_ridge": (RIDGE,),
    "draw_ridge of exact delays": (stack([ridge(model=""), ridge(0.5, "")]),),
    "draw_slope": (stack([ridge(model=""), ridge(0.5, "")]), SLOPES),
    "draw_passivity_cost": (COSTS,),
    "draw_response": (RESPONSE,),
    "draw_workspace": (POSES, "shoulder_deg", "elbow_deg"),
    "draw_workspace of scattered poses": (SCATTERED, "shoulder_deg", "elbow_deg"),
    "draw_response without a wall": ({name: RESPONSE[name] for name in list(RESPONSE)[:4]},),
    "draw_step": (stack([response("first"), response("second", np.nan)]),),
    "draw_step normalized": (stack([response("first", physical=False)]),),
    "draw_map of radius": (grid_map(), "spectral_radius"),
    "draw_map of stable": (in_si(grid_map()), "stable"),
    "draw_map of many": (grid_map(np.linspace(0, 1, 7)), "passive"),
}
