"""Reading what people write: YAML files, units, axes, devices and walls, each fault with its place and its remedy."""
