"""Any linear loop of a virtual wall: which walls put poles on the unit circle, and all that follows from it."""
