"""Files: atomic replacement, text files with columns, and the times in recordings."""
