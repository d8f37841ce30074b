"""Helpers that every other package may use: errors, files, settings, provenance, colors and more."""
