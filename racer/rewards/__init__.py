"""Reward functions in DeepRacer's form, ``def reward_function(params) -> float``: checked, and run for all cars of a step at once.

:mod:`~racer.rewards.parameters` has the contract, :mod:`~racer.rewards.guard` checks a file before any job starts, and
:class:`racer.rewards.reward.RewardFunction` runs it: compiled to the device where it can be translated, else in processes.
"""
