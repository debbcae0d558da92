"""Stability, poles, margins and passivity of virtual walls on rigid devices, from closed forms."""
