"""Simulate virtual walls in the time domain, with contact, friction, encoder and other nonlinear effects.

The simulation also tests the stability theory independently (docs/theory/simulation.md).
"""
