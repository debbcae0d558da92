"""Shared definitions: errors, status codes, types, units, quantities, formatting, tables and array namespaces."""
