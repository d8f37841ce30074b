"""Training of the general policy: one network for every agent, trained on families of missions, teams and layouts."""
