"""A local page on which the parameters of a scene are moved and its stable walls follow."""
