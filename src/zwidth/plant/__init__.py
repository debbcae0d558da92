"""The sampled plant: a device discretized exactly under a delayed zero-order hold."""
