"""The loop of a wall, normalized: where it is computed, and its kernels, rigid and with parts."""
