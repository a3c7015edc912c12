"""Learning: PPO on rsl-rl's models and storage, the loop around it, and the whole training state."""
