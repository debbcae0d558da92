"""Identification of a device from logs of its motion, or from walls at the onset of instability."""
