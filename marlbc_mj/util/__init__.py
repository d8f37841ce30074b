"""Errors, files, provenance and colors: what every other package may use, and what knows none of them."""
