"""Any linear loop of a virtual wall: the poles that its walls put on the unit circle, and all that follows from them."""
