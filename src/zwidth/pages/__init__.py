"""Results for the reader: printed lines of the command line (`words`, `verdict`), and the page of `zwidth explore`."""
