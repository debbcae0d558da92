"""The explorer, a page for a browser, and the words in which it and the command line answer."""
