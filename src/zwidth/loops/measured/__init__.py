"""The loop of a device that is known by its measured frequency response alone (docs/theory/measured.md)."""
