"""Plant estimates from one experiment: frequency response, rigid body, identified state space."""
