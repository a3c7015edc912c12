"""Running tasks: the protocol of a control step, resets, records of episodes, saved worlds."""
