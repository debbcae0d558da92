"""The parts of a loop, each in one file with its source, its equations and its units; values are checked where made."""
