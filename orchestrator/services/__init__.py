"""Use cases: what a person, a program or the controller itself asks for, each with typed arguments and an explicit actor."""
