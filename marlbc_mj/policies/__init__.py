"""Learned policies without torch: inputs, action sets, decisions, checkpoints."""
