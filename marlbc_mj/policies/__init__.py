"""Running learned policies without torch: inputs, action sets, decisions, checkpoints."""
