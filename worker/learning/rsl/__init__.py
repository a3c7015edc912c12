"""rsl_rl's algorithms on Muster's worlds: any configuration of rsl_rl 5.5, in its own keys."""
