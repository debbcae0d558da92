"""The report of a finished run: one HTML file that works without a server and without a network."""
