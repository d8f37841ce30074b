"""The suite: a fixed set of missions in tracks, identified by a hash, on which supervisors and controllers are compared."""
