"""The loop of a wall, normalized, by kernels: of a rigid device in closed form, and of any linear loop."""
