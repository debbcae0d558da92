"""The time domain: what the linear theory leaves out, and its independent judge (docs/theory/simulation.md)."""
