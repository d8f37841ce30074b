"""Learners of mission supervisors. Nothing is in here yet: the environment they need is ``marlbc_mj.engine.world.World``."""
