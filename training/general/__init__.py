"""Training of the general policy: one network for every agent, over families, teams and layouts."""
