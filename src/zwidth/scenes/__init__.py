"""Scenes in SI units and every question about their walls: verdict, stiffest wall, price, robustness, limits."""
