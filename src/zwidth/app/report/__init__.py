"""Write the report of a finished run: one HTML file that needs neither a server nor a network."""
