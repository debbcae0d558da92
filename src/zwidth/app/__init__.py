"""Results for the reader: printed lines of the command line, the HTML report, and the page of `zwidth explore`."""
