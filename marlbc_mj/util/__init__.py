"""Errors, files, provenance and colors: the helpers that every other package may use."""
