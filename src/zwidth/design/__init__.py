"""Design questions, answered through the exact model: how stiff, at what price, how well damped, how robust."""
