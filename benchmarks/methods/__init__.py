"""Measuring what each method costs and how wrong it can be, beside the tools people would use otherwise."""
