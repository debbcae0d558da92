"""Physical quantities: symbols, units and ranges, unit systems, parsing and formatting of values, plausibility."""
