"""Learned policies without torch: what they see, what they choose from, how they decide, how they are read."""
