"""The rigid loop by its closed forms: one question a file."""
