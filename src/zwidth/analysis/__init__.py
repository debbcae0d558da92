"""Analyses of scenes in SI units: stability, maximum stiffness, margins, robustness, recommendation and diagnosis."""
