"""Sensors of robots: contacts, frames, inertial measurements and momenta of all worlds, measured inside the graph of a step."""
