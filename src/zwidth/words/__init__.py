"""What is said: errors, statuses, types, units, formats, and every parameter and output declared once."""
