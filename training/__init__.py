"""Training of mission supervisors: configurations, trainers, networks, runs on disk, checkpoints and their export."""
