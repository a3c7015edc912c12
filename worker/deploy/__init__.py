"""The policy bundle: what runs a trained policy on a robot, made from a checkpoint and compared with it before it appears."""
