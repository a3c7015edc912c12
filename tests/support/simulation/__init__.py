"""A deterministic simulation of the control plane: the real loop, on a machine, engines, a bus, a store and a database that a seed breaks."""
